"""What to think of a workspace's result, in words for the end of a run and for programs."""

import shlex

from refdgs_pipe import recipe
from refdgs_pipe.cli.workspace import Workspace, default_root
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
    """The verdict and what is worst about the result; all of it is in the report."""
    lines = [f"verdict: {verdict.line.replace(': ', ', ')}"]
    worse = [f for f in verdict.findings if f.word in ("poor", "fair")]
    lines += [f"  {found.plain} ({found.value})" for found in worse[:_SHOWN]]
    if len(worse) > _SHOWN:
        lines.append(f"  and {len(worse) - _SHOWN} more in the report")
    return lines


def to_do(space: Workspace, verdict: Verdict) -> list[str]:
    """What makes the result better, the most useful first; a size is asked for elsewhere."""
    photos = space.memory.photos
    worse = [f for f in verdict.findings if f.word in ("poor", "fair")][:_SHOWN]
    notes = [f for f in verdict.findings if f.word is None and f.about != "size"]
    steps = [found.advice for found in (*worse, *notes) if found.advice]
    if verdict.draft and photos:
        given = " ".join(shlex.quote(str(path)) for path in photos[:2]) + " ..." * (len(photos) > 2)
        where = f" -w {shlex.quote(str(space.root))}"
        own = default_root(photos) == space.root
        command = f"refdgs-pipe run {given}{'' if own else where} --recipe {recipe.DEFAULT}"
        steps.insert(0, f"make it at full quality: {command}")
    return list(dict.fromkeys(steps))
