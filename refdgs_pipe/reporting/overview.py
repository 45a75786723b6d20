"""The top of the report: the verdict, why, what to do, and what the asset is in a few figures."""

from contextlib import suppress
from dataclasses import dataclass

from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.errors import RefdgsError
from refdgs_pipe.evaluation.verdict import Verdict, judged
from refdgs_pipe.formatting import duration, figure, merged, size
from refdgs_pipe.recipe import DEFAULT
from refdgs_pipe.reporting.dimensions import dimensions, is_size_known
from refdgs_pipe.reporting.facts import Facts, Result
from refdgs_pipe.reporting.html import Content, Html, coded, table, tag
from refdgs_pipe.reporting.photos import photo_faults
from refdgs_pipe.reporting.placement import lost_photos

_WORDS = {
    "failed": "Failed: the last run ended with an error.",
    "unfinished": "Unfinished: not every stage has run.",
    "stale": "Out of date: photos, settings or the program have changed since. `run` brings it up "
    "to date; until then this is the last run's result.",
    "unjudged": "Done: every stage has run, but there are no scores to judge the result by.",
}
_JUDGED = {
    "good": "nothing that was measured on the object speaks against it.",
    "fair": "it can be used, but see what is worst about it.",
    "poor": "do not trust it before the worst of this is mended.",
}
_NAMED = 6  # photos that are named in a sentence
_FIRST = 3  # reasons that are told at the top


@dataclass(frozen=True)
class Reason:
    """What it is about (a stage, a figure), in words, what to do; good, fair, poor or "".

    Args:
        plain: the same without figures.
    """

    about: str
    words: str
    advice: str = ""
    word: str = ""
    plain: str = ""


@dataclass(frozen=True)
class Opinion:
    """How the workspace stands, or what its result is worth, and why.

    Args:
        word: good, fair or poor; where there is nothing to judge: failed, unfinished, stale or
            unjudged.
        line: the first line that people read.
    """

    word: str
    line: str
    reasons: tuple[Reason, ...]


def judge(facts: Facts) -> Opinion:
    """What to think of the workspace's results."""
    warnings = _warnings(facts)
    failure = facts.notes.failure
    waiting = [r.name for r in facts.results if not r.is_current]
    if failure and (waiting or not facts.results):
        told = Reason(failure.stage or "run", facts.plain(failure.message))
        return Opinion("failed", _WORDS["failed"], (told, *warnings))
    if waiting:
        old = [name for name in waiting if name not in facts.missing]
        lists = (("not run", facts.missing), ("out of date", old))
        told_of = [Reason(word, ", ".join(names)) for word, names in lists if names]
        state = "unfinished" if facts.missing else "stale"
        return Opinion(state, _WORDS[state], (*told_of, *warnings))
    verdict = _verdict(facts)
    if verdict is None:
        return Opinion("unjudged", _WORDS["unjudged"], warnings)
    found = tuple(
        Reason(f.about, f.value, f.advice, f.word or "", f.plain) for f in verdict.findings
    )
    line = f"{verdict.line[0].upper()}{verdict.line[1:]}"
    line += f"{'.' if verdict.draft else ':'} {_worded(verdict)}"
    return Opinion(verdict.word, line, (*found, *warnings))


def _warnings(facts: Facts) -> tuple[Reason, ...]:
    """What the stages warned about; equal warnings once."""
    by_stage: dict[str, list[str]] = {}
    for stage, words in facts.warnings:
        by_stage.setdefault(stage, []).append(words)
    return tuple(Reason(name, text) for name, texts in by_stage.items() for text in merged(texts))


def _worded(verdict: Verdict) -> str:
    words = _JUDGED[verdict.word]
    return f"{words[0].upper()}{words[1:]}" if verdict.draft else words


def _verdict(facts: Facts) -> Verdict | None:
    """On the scores; None where there are none, or none that can be read."""
    with suppress(RefdgsError):
        evidence = facts.load(Scores).evidence
        return None if evidence is None else judged(evidence, draft=facts.draft)
    return None


def head(facts: Facts) -> Html:
    """The verdict, why, and what to do; every figure behind it on demand."""
    opinion = judge(facts)
    judged_ones = [r for r in opinion.reasons if r.plain]
    others = [r for r in opinion.reasons if not r.plain]
    worse = [r for r in judged_ones if r.word in ("poor", "fair")]
    notes = [r for r in judged_ones if not r.word]
    why = [_sentence(reason) for reason in [*worse[:_FIRST], *notes]]
    why += [tag("li", tag("b", r.about), f": {r.words}") for r in others]
    if not worse and judged_ones:
        best = [r.plain for r in judged_ones if r.word == "good"][:_FIRST]
        why = [*(tag("li", f"{words}.") for words in best), *why]
    steps = [tag("li", coded(text)) for text in _to_do(facts, [*worse[:_FIRST], *notes])]
    return tag(
        "div",
        tag("p", opinion.line, class_="line"),
        tag("h2", "Why") if why else Html(""),
        tag("ul", *why) if why else Html(""),
        tag("h2", "What to do") if steps else Html(""),
        tag("ol", *steps) if steps else Html(""),
        _figures(judged_ones),
        id="verdict",
        class_=f"verdict {opinion.word}",
        role="region",
        aria_label="Verdict",
    )


def _sentence(reason: Reason) -> Html:
    if not reason.word:
        return tag("li", f"{reason.plain}.")
    mark = tag("b", reason.word, class_=f"mark {reason.word}")
    return tag("li", mark, f" {reason.plain}.")


def _to_do(facts: Facts, reasons: list[Reason]) -> list[str]:
    """What makes the result better, the most useful first."""
    steps = []
    if facts.draft:
        command = f"refdgs-pipe run PHOTOS --recipe {DEFAULT}"
        steps.append(f"This was a first look. For full quality: `{command}`")
    lost, blurred = _bad_photos(facts)
    if lost:
        steps.append(f"Take photos between these and the others: {_named(lost)}")
    if blurred:
        steps.append(f"Take these again, they are blurred: {_named(blurred)}")
    steps += [f"{r.advice[0].upper()}{r.advice[1:]}" for r in reasons if r.advice]
    return list(dict.fromkeys(steps))


def _bad_photos(facts: Facts) -> tuple[list[str], list[str]]:
    """The user's names of the photos without a place, and of the blurred ones."""
    with suppress(RefdgsError, OSError, ValueError, KeyError):
        views = facts.load(Views)
        faults = photo_faults(views, lost_photos(facts))
        names = {view.name: view.source or view.name for view in views.items}
        found = [(names.get(name, name), fault) for name, fault in faults.items()]
        lost = [name for name, fault in found if "lost" in fault]
        return lost, [name for name, fault in found if "lost" not in fault]
    return [], []


def _named(names: list[str]) -> str:
    rest = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {rest} more" if rest > 0 else "")


def _figures(reasons: list[Reason]) -> Html:
    """Everything that was judged, with its figure."""
    if not reasons:
        return Html("")
    rows: list[tuple[Content, ...]] = [
        (r.about, tag("b", r.word or "note", class_=f"mark {r.word}"), r.words) for r in reasons
    ]
    whole = table(("what was judged", "verdict", "figure"), rows, class_="checks")
    return tag("details", tag("summary", "All that was judged, with figures"), whole)


def tiles(facts: Facts) -> Html:
    """The asset in a few figures, as far as they are known."""
    found: list[tuple[str, Content]] = []
    placed = facts.result(SparseModel)
    if placed and "registered" in placed.measures:
        found.append(("photos used", str(placed.measures["registered"][0])))
    elif (read := facts.result(Views)) and "photos" in read.measures:
        found.append(("photos", _plain(read, "photos")))
    asset = facts.result(Asset)
    if asset and asset.folder and (box := dimensions(asset.folder / "asset.glb")):
        told = str(asset.measures.get("size", ("unknown", ""))[0])
        label = "width x height x depth" + ("" if is_size_known(told) else "; real size unknown")
        found.append((label, box.words))
    if asset and "faces" in asset.measures:
        found.append(("triangles", _plain(asset, "faces")))
    baked = facts.result(TexturedMesh)
    if baked and "texture size" in baked.measures:
        found.append(("texture, in pixels", _plain(baked, "texture size")))
    if asset and asset.manifest and "asset.glb" in asset.manifest.files:
        found.append(("asset.glb", size(asset.manifest.files["asset.glb"][0])))
    seconds = sum(r.manifest.seconds for r in facts.results if r.manifest)
    if seconds:
        found.append(("it took", duration(seconds)))
    boxes = [
        tag("div", tag("dt", label), tag("dd", value), class_="tile") for label, value in found
    ]
    return tag("dl", *boxes, class_="tiles") if boxes else Html("")


def _plain(result: Result, name: str) -> str:
    value = result.measures[name][0]
    return f"{value:,}" if isinstance(value, int) else figure(value)
