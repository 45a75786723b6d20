"""good, fair or poor: what the evidence says of a result, in words, with what to do about it.

docs/verdict.md says how the thresholds were found, and how well the verdict agrees with truth.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from refdgs_pipe.artifacts.object_figures import ObjectFigures

Word = Literal["good", "fair", "poor"]
Told = tuple[str, str] | None  # the value in words, and what to do about it


@dataclass(frozen=True)
class Finding:
    """One thing that was judged.

    Args:
        about: what, as in "sharpness against unseen photos".
        word: None for a note, which decides nothing.
        value: the figure in words, as in "24 dB".
        advice: what to do about it; empty where nothing is to be done.
        mark: below 0 is poor, from 1 on is good; evenly in between.
        plain: the same in a sentence without figures, for people who do not know them.
    """

    about: str
    word: Word | None
    value: str
    advice: str
    mark: float
    plain: str = ""

    @property
    def text(self) -> str:
        """The finding in one line: "sharpness against unseen photos: fair, 24 dB"."""
        return f"{self.about}: {self.word}, {self.value}" if self.word else self.value


@dataclass(frozen=True)
class Verdict:
    """What to think of a result.

    Args:
        word: the worst of its findings' words.
        score: mean of the two lowest marks, for comparing results: below 0 is bad, 1 is good.
        findings: worst first, notes last.
        draft: the recipe is meant for a first look.
    """

    word: Word
    score: float
    findings: tuple[Finding, ...]
    draft: bool = False

    @property
    def line(self) -> str:
        """The verdict alone: "fair: a first look"."""
        return f"{self.word}: a first look" if self.draft else self.word

    def record(self) -> dict[str, object]:
        """As JSON has it."""
        reasons = [
            {
                "about": f.about,
                "word": f.word,
                "value": f.value,
                "advice": f.advice,
                "plain": f.plain,
            }
            for f in self.findings
        ]
        return {"word": self.word, "line": self.line, "score": self.score, "reasons": reasons}


@dataclass(frozen=True)
class _Aspect:
    """One figure and where it is poor and good.

    Args:
        value: the figure; None where it was not measured.
        words: the figure in words; advice: what to do where it is not good.
        plain: what poor, fair and good mean, each in a sentence.
    """

    about: str
    value: Callable[[ObjectFigures], float | None]
    poor: float
    good: float
    words: Callable[[ObjectFigures], str]
    advice: str
    plain: tuple[str, str, str]

    def finding(self, evidence: ObjectFigures) -> Finding | None:
        """None where there is nothing to judge."""
        value = self.value(evidence)
        if value is None:
            return None
        mark = (value - self.poor) / (self.good - self.poor)
        word: Word = "poor" if mark < 0 else "good" if mark >= 1 else "fair"
        advice = "" if word == "good" else self.advice
        plain = self.plain[("poor", "fair", "good").index(word)]
        return Finding(self.about, word, self.words(evidence), advice, mark, plain)


def _gap(evidence: ObjectFigures) -> float | None:
    if evidence.psnr is None or evidence.training_psnr is None:
        return None
    return evidence.training_psnr - evidence.psnr


def _gap_words(gap: float) -> str:
    return f"{gap:.1f} dB worse" if gap >= 0.05 else "no worse"


def _placed(evidence: ObjectFigures) -> float | None:
    return evidence.placed / evidence.photos if evidence.photos else None


_ASPECTS = (
    _Aspect(
        "sharpness against unseen photos",
        lambda e: e.psnr,
        16.0,
        26.0,
        lambda e: f"{e.psnr:.0f} dB on the object",
        "train longer (after `preview` the recipe `glossy`, else more `train.iterations`), or take "
        "sharper photos with the same exposure",
        (
            "Seen from a new place, the object looks blurred or wrong",
            "Seen from a new place, the object lacks fine detail",
            "Seen from a new place, the object looks as in the photos",
        ),
    ),
    _Aspect(
        "unseen photos beside those of the training",
        _gap,
        12.0,  # a flat mirror alone makes 7 dB: what it shows at a new place was never learned
        2.0,
        lambda e: _gap_words(_gap(e) or 0.0),
        "take more photos all round, with less than 15 degrees between neighbours",
        (
            "Between the photos the object looks much worse than in them",
            "Between the photos the object looks worse than in them",
            "Between the photos the object looks as good as in them",
        ),
    ),
    _Aspect(
        "photos with a trusted place",
        _placed,
        0.6,
        0.9,
        lambda e: f"{e.placed} of {e.photos}",
        "take photos between the lost ones and the others; the section Photos of the report names "
        "them",
        (
            "Many photos could not be used, because nothing tells where they were taken",
            "Some photos could not be used, because nothing tells where they were taken",
            "Nearly all photos could be used",
        ),
    ),
    _Aspect(
        "height of the lowest photo",
        lambda e: e.lowest,
        60.0,
        30.0,
        lambda e: f"the lowest looks down from {e.lowest:.0f} degrees",
        "add a ring of photos from 10 to 20 degrees",
        (
            "All photos are from far above: the shape of walls and of the top is a guess",
            "All photos are from above: plain walls and a plain top may have a wrong shape",
            "Some photos are from low enough to show the walls",
        ),
    ),
    _Aspect(
        "surface whose shape is well known",
        lambda e: e.seen,
        0.45,
        0.75,
        lambda e: f"{e.seen:.0%} is well known, nobody saw {e.unseen:.0%}",
        "take more photos of the places that the section Coverage of the report shows in red and "
        "yellow",
        (
            "The shape of much of the surface is a guess",
            "The shape of some of the surface is a guess",
            "The photos tell the shape of nearly all of the surface",
        ),
    ),
    _Aspect(
        "holes in the surface",
        lambda e: e.hole_length,
        4.0,
        0.5,
        lambda e: f"{e.holes}, their rims {e.hole_length:.1f} times the diagonal",
        "raise `clean.hole` to close them, or photograph what is behind them",
        (
            "The surface has large holes",
            "The surface has holes",
            "The surface has no holes that matter",
        ),
    ),
    _Aspect(
        "where the object stands",
        lambda e: e.floats,
        0.1,
        0.03,
        lambda e: f"it ends {e.floats:.0%} of its diagonal above the ground",
        "look at the section Masks of the report: a part below that looks like the ground may be "
        "missing; give masks",
        (
            "The object floats above the ground: its lower part is missing",
            "The object ends a little above the ground: its foot may be missing",
            "The object stands on the ground",
        ),
    ),
    _Aspect(
        "parts that nothing holds",
        lambda e: e.hanging,
        0.1,
        0.01,
        lambda e: f"{e.hanging:.0%} of the surface",
        "look at the section Masks of the report: what is between the parts is missing; take more "
        "photos of it before a textured ground, or give masks",
        (
            "A part of the object hangs in the air: what holds it is missing",
            "A small part of the object hangs in the air: what holds it is missing",
            "No part of the object hangs in the air",
        ),
    ),
    _Aspect(
        "loose bits of surface",
        lambda e: e.part_share,
        0.1,
        0.01,
        lambda e: f"{e.parts}, {e.part_share:.0%} of the surface",
        "raise `clean.floater` to remove them, or give masks",
        (
            "Much of the surface is loose pieces",
            "Some loose pieces float around the object",
            "No loose pieces float around the object",
        ),
    ),
    _Aspect(
        "outlines of the mesh against those of the object",
        lambda e: e.outline,
        4.0,
        1.0,
        lambda e: f"{e.outline:.1f} % of its size apart",
        "look at the section Mesh of the report; give masks, more photos, or train longer",
        (
            "The outline of the model is clearly not that of the object",
            "The outline of the model differs a little from that of the object",
            "The outline of the model is that of the object",
        ),
    ),
    _Aspect(
        "shape, from one view to the next",
        lambda e: e.contradicted,
        0.15,
        0.03,
        lambda e: f"{e.contradicted:.0%} of what one view sees is denied by another",
        "look at the section Cameras of the report; take more photos, or train longer",
        (
            "The shape contradicts itself from one side to the other",
            "The shape contradicts itself in places",
            "The shape agrees with itself from all sides",
        ),
    ),
    _Aspect(
        "mesh against the depth that it was made of",
        lambda e: e.depth,
        1.5,
        0.4,
        lambda e: f"{e.depth:.2f} % of the diagonal apart",
        "take more photos, train longer, or lower `extract.voxel`",
        (
            "The mesh is much coarser than the shape that was learned",
            "The mesh is a little coarser than the shape that was learned",
            "The mesh follows the shape that was learned",
        ),
    ),
    _Aspect(
        "surface that its photos explain",
        lambda e: None if e.unexplained is None else 1 - e.unexplained,
        0.3,
        0.9,
        lambda e: (
            f"{1 - (e.unexplained or 0):.0%}: the rest has neither one colour nor one "
            "reflection in all photos"
        ),
        "look for closed hollows and for bulges in the section Mesh; take more photos, also into "
        "hollows, or use the recipe `glossy`",
        (
            "Much of the surface is not where the photos show it: a hollow may be closed",
            "Part of the surface may not be where the photos show it, as over a closed hollow",
            "Colours and reflections fit the surface",
        ),
    ),
    _Aspect(
        "asset, in the light that was found, against photos",
        lambda e: e.asset_psnr,
        13.0,
        22.0,
        lambda e: f"{e.asset_psnr:.0f} dB on the object, the field itself {e.psnr:.0f} dB",
        "compare the pictures in the section Photo and result of the report; longer training and a "
        "larger `bake.size` help",
        (
            "With its textures, the asset looks clearly unlike the photos",
            "With its textures, the asset looks somewhat unlike the photos",
            "With its textures, the asset looks as in the photos",
        ),
    ),
)
SCORED = 2  # lowest marks: a result is as bad as the worst of it
WEAK = 1 / 3  # score below which figures make a result poor together
_RANK = {"poor": 0, "fair": 1, "good": 2, None: 3}


def judged(evidence: ObjectFigures, *, draft: bool = False) -> Verdict:
    """What the evidence says.

    The verdict is as bad as the worst finding. Two that are nearly poor make one that is. Whether
    the size is known is a note: it says nothing of the quality.

    Args:
        draft: the result is meant for a first look; only the words say so.
    """
    found = [f for aspect in _ASPECTS if (f := aspect.finding(evidence)) is not None]
    if evidence.psnr is None:
        advice = "look at `refdgs-pipe render WORKSPACE`; give masks or more photos"
        plain = "No photo shows the object"
        found.append(Finding("the object", "poor", "no photo shows it", advice, -1.0, plain))
    found.sort(key=lambda f: (_RANK[f.word], f.mark))
    marks = sorted(min(max(f.mark, -1.0), 1.5) for f in found)[:SCORED]
    score = sum(marks) / len(marks)
    if score < WEAK and found[0].word != "poor":
        found.insert(0, _weak(found[:SCORED], score - WEAK))
    return Verdict(found[0].word or "poor", score, (*found, *_notes(evidence)), draft)


def _weak(found: list[Finding], mark: float) -> Finding:
    """That figures which are not poor by themselves are so together."""
    value = " and ".join(finding.about for finding in found)
    plain = "Some figures are so weak together that the result is hard to trust"
    return Finding("the weakest figures together", "poor", value, found[0].advice, mark, plain)


def _notes(evidence: ObjectFigures) -> list[Finding]:
    notes = []
    if not evidence.held_out:
        words = "no photo was held out: figures are of photos that it was trained with"
        plain = "Every photo was used for learning, so none is left to test the result with"
        notes.append(Finding("held-out photos", None, words, "give 16 photos or more", 1.0, plain))
    if not evidence.masked:
        words = "no masks: the object is what the field and the mesh show of it"
        plain = "No masks say where the object ends, so its edges are less certain"
        notes.append(Finding("masks", None, words, "", 1.0, plain))
    if not evidence.metres:
        words = "size unknown: a unit is taken for a metre"
        plain = "The real size is unknown"
        advice = "give `--size METRES`, or use a mat"
        notes.append(Finding("size", None, words, advice, 1.0, plain))
    return notes
