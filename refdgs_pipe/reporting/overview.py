"""The top of the report: the verdict with its reasons, and the figures that say most."""

from contextlib import suppress
from dataclasses import dataclass

from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.errors import RefdgsError
from refdgs_pipe.evaluation.verdict import Verdict, judged
from refdgs_pipe.formatting import duration, figure, size
from refdgs_pipe.pipeline.stage import Artifact
from refdgs_pipe.reporting.facts import Facts
from refdgs_pipe.reporting.html import Content, Html, joined, tag

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


@dataclass(frozen=True)
class Reason:
    """What it is about (a stage, a figure), in words, what to do; good, fair, poor or ""."""

    about: str
    words: str
    advice: str = ""
    word: str = ""


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
    warnings = tuple(Reason(stage, words) for stage, words in facts.warnings)
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
    found = tuple(Reason(f.about, f.value, f.advice, f.word or "") for f in verdict.findings)
    line = f"{verdict.line[0].upper()}{verdict.line[1:]}"
    line += f"{'.' if verdict.draft else ':'} {_worded(verdict)}"
    return Opinion(verdict.word, line, (*found, *warnings))


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
    """The verdict and its reasons, the worst first."""
    opinion = judge(facts)
    reasons = [_reason(reason) for reason in opinion.reasons]
    return tag(
        "div",
        tag("p", opinion.line, class_="line"),
        tag("ul", *reasons) if reasons else Html(""),
        id="verdict",
        class_=f"verdict {opinion.word}",
    )


def _reason(reason: Reason) -> Html:
    if not reason.word:
        words = joined(tag("b", reason.about), Html(" &middot; "), reason.words)
    else:
        mark = tag("b", reason.word, class_=f"mark {reason.word}")
        words = joined(mark, f" {reason.about}: {reason.words}")
    advice = tag("span", f" To do: {reason.advice}.", class_="todo") if reason.advice else Html("")
    return tag("li", words, advice)


def tiles(facts: Facts) -> Html:
    """The figures that say most, as far as they are known."""
    found: list[tuple[str, Content, str]] = []

    def add(label: str, kind: type[Artifact], name: str, unit: str = "") -> None:
        result = facts.result(kind)
        if result and name in result.measures:
            value, own = result.measures[name]
            words = f"{value:,}" if isinstance(value, int) else figure(value)
            found.append((label, words, unit or own))

    add("photos", Views, "photos")
    add("have a camera", SparseModel, "registered")
    evaluated = facts.result(Scores)
    for name, (value, unit) in (evaluated.measures if evaluated else {}).items():
        if name.startswith(("PSNR", "SSIM", "normal error", "Chamfer")):
            short, _, remark = unit.partition(", ") if ", " in unit else (unit, "", "")
            if short.startswith("% "):
                short, remark = "%", short[2:]
            found.append((f"{name}, {remark}" if remark else name, figure(value), short))
    add("surfels", SurfelField, "surfels")
    add("triangles", Asset, "faces")
    add("texture", TexturedMesh, "texture size")
    if (asset := facts.result(Asset)) and "size" in asset.measures:
        value, remark = length_told(str(asset.measures["size"][0]))
        found.append((f"longest side{remark}", value, ""))
    if (result := facts.result(Asset)) and result.manifest:
        files = result.manifest.files
        for name in ("asset.glb", "asset.usdz"):
            if name in files:
                found.append((name, size(files[name][0]), ""))
    seconds = sum(r.manifest.seconds for r in facts.results if r.manifest)
    if seconds:
        found.append(("all stages took", duration(seconds), ""))
    return tag("div", *(_tile(*entry) for entry in found), class_="tiles")


def length_told(told: str) -> tuple[str, str]:
    """What export says of the size, as the value of a tile and a remark on it."""
    if told.startswith("unknown: "):
        return told.removeprefix("unknown: exported ").partition(" long")[0], ", size unknown"
    value, _, remark = told.partition(", ")
    return value, f", {remark}" if remark else ""


def _tile(label: str, value: Content, unit: str) -> Html:
    number = joined(value, tag("small", f" {unit}") if unit else "")
    return tag("div", tag("span", number, class_="value"), tag("span", label), class_="tile")
