"""What to think of a workspace's result, in words for the end of a run and for programs."""

from refdgs_pipe import recipe
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.errors import InputError, RefdgsError
from refdgs_pipe.evaluation.verdict import Verdict, judged

STAGE = "evaluate"
_SHOWN = 3  # reasons at the end of a run


def verdict_of(space: Workspace) -> Verdict | None:
    """The verdict on the current scores; None where they are not made, or cannot be read."""
    from refdgs_pipe.artifacts.scores import Scores

    try:
        _, folder = space.result(STAGE)
        evidence = Scores.load(folder).evidence
    except RefdgsError:
        return None
    return None if evidence is None else judged(evidence, draft=is_draft(space))


def is_draft(space: Workspace) -> bool:
    """Whether the recipe says of itself that it is for a first look."""
    try:
        return recipe.load(space.memory.recipe).draft
    except InputError:  # a recipe's file that is gone
        return False


def closing_lines(verdict: Verdict) -> list[str]:
    """The verdict, and what is worst about the result; all of it is in the report."""
    lines = [f"verdict: {verdict.line}"]
    worse = [f for f in verdict.findings if f.word in ("poor", "fair")]
    for found in worse[:_SHOWN]:
        lines.append(f"  {found.text}" + (f": {found.advice}" if found.advice else ""))
    if len(worse) > _SHOWN:
        lines.append(f"  and {len(worse) - _SHOWN} more in the report")
    lines += [f"  {f.value}: {f.advice}" for f in verdict.findings if not f.word and f.advice]
    return lines
