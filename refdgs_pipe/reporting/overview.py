"""The top of the report: the verdict with its reasons, and the figures that say most."""

from dataclasses import dataclass

from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Artifact
from refdgs_pipe.reporting.facts import Facts
from refdgs_pipe.reporting.html import Content, Html, joined, tag
from refdgs_pipe.wording import duration, figure, size

_WORDS = {
    "good": "Good: every stage is done and none of them warned.",
    "degraded": "Degraded: the asset is there, but read these warnings.",
    "failed": "Failed: the last run ended with an error.",
    "unfinished": "Unfinished: not every stage has run.",
    "stale": "Out of date: photos, settings or the program have changed since. `run` brings it up "
    "to date; until then this is the last run's result.",
}


@dataclass(frozen=True)
class Verdict:
    """good, degraded, failed, unfinished or stale, and why: (stage, words)."""

    word: str
    reasons: tuple[tuple[str, str], ...]


def judge(facts: Facts) -> Verdict:
    """What to think of the workspace's results; "degraded" means the same as for `run --json`."""
    reasons = facts.warnings
    failure = facts.notes.failure
    waiting = [r.name for r in facts.results if not r.is_current]
    if failure and (waiting or not facts.results):
        told = (failure.stage or "run", facts.plain(failure.message))
        return Verdict("failed", (told, *reasons))
    if waiting and not facts.missing:
        return Verdict("stale", (("out of date", ", ".join(waiting)), *reasons))
    if waiting:
        old = [name for name in waiting if name not in facts.missing]
        lists = (("not run", facts.missing), ("out of date", old))
        told_of = [(word, ", ".join(names)) for word, names in lists if names]
        return Verdict("unfinished", (*told_of, *reasons))
    return Verdict("degraded" if reasons else "good", tuple(reasons))


def head(facts: Facts) -> Html:
    """The verdict and its reasons."""
    verdict = judge(facts)
    reasons = [
        tag("li", tag("b", stage), Html(" &middot; "), words) for stage, words in verdict.reasons
    ]
    return tag(
        "div",
        tag("p", _WORDS[verdict.word], class_="line"),
        tag("ul", *reasons) if reasons else Html(""),
        id="verdict",
        class_=f"verdict {verdict.word}",
    )


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
    add("longest side", Asset, "size")
    if (result := facts.result(Asset)) and result.manifest:
        files = result.manifest.files
        for name in ("asset.glb", "asset.usdz"):
            if name in files:
                found.append((name, size(files[name][0]), ""))
    seconds = sum(r.manifest.seconds for r in facts.results if r.manifest)
    if seconds:
        found.append(("all stages took", duration(seconds), ""))
    return tag("div", *(_tile(*entry) for entry in found), class_="tiles")


def _tile(label: str, value: Content, unit: str) -> Html:
    number = joined(value, tag("small", f" {unit}") if unit else "")
    return tag("div", tag("span", number, class_="value"), tag("span", label), class_="tile")
