"""What a quick look means for the user: findings in plain words, and a verdict over them."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.checking import pixels
from refdgs_pipe.checking.look import Look
from refdgs_pipe.errors import CaptureError, PoseError
from refdgs_pipe.formatting import counted
from refdgs_pipe.imaging.quality import blurred
from refdgs_pipe.sfm.around import around

State = Literal["ok", "note", "but", "bad"]
Word = Literal["yes", "but", "unclear", "no"]
NAMES_SHOWN = 6
GAP_DEG = 60.0
MANY = 0.25  # of the photos, clipped on the object: highlights alone do not reach that
_TOLD = re.compile(r"look blurred|files skipped|have no mask|of other photos and left out")


@dataclass(frozen=True)
class Finding:
    """One line of the check.

    Args:
        name: what was looked at.
        state: "ok"; "note", worth knowing; "but", makes the result worse; "bad", stops the run.
        text: what was found; advice: what to do about it, or empty.
        photos: the user's names of the photos that it is about.
    """

    name: str
    state: State
    text: str
    advice: str = ""
    photos: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """Whether the photos can be used.

    Args:
        word: "yes"; "but", with what makes it worse; "unclear", the quick try failed; "no".
        line: in words; to_do: what to do, most important first.
        exit_code: of the command.
    """

    word: Word
    line: str
    to_do: tuple[str, ...]
    exit_code: int


def judge(look: Look, findings: Sequence[Finding]) -> Verdict:
    """The verdict over the findings of a look."""
    order: tuple[State, ...] = ("bad", "but")
    to_do = tuple(dict.fromkeys(f.advice for s in order for f in findings if f.state == s))
    to_do = tuple(advice for advice in to_do if advice)
    if look.views is None or (look.is_known and look.model is None):
        code = CaptureError.exit_code if look.views is None else PoseError.exit_code
        return Verdict("no", "These photos cannot be used.", to_do, code)
    if look.judgement is not None and not look.judgement.is_trusted:
        line = (
            "Not clear yet: the quick try could not place enough photos. `run` tries harder, with "
            "more and finer features, and may succeed; it stops before training if it does not."
        )
        return Verdict("unclear", line, to_do, PoseError.exit_code)
    if any(finding.state in order for finding in findings):
        line = "These photos can be used, but the result will be worse than it could be."
        return Verdict("but", line, to_do, 0)
    return Verdict("yes", "These photos can be used.", (), 0)


def findings_of(look: Look) -> tuple[Finding, ...]:
    """All findings of a look, in the order of the pipeline."""
    views = look.views
    if views is None:
        return (Finding("photos", "bad", look.refused, "Put photos that can be read there"),)
    return (
        _read(look, views),
        *_copies(views),
        _sharpness(views),
        *_exposure(look, views),
        _masks(views),
        *_other_warnings(look),
        *light(views),
        *_background(look),
        *_placement(look),
        *_coverage(look),
        _size(look),
    )


def _read(look: Look, views: Views) -> Finding:
    size = "" if look.megapixels is None else f" of {look.megapixels:.0f} megapixels"
    if look.megapixels is not None and look.megapixels < 1:
        size = f" of {look.megapixels:.1f} megapixels"
    text = f"{counted(len(views.items), 'photo')}{size} read"
    lost = [s for s in views.skipped if not s.harmless and not s.copy_of]
    if not lost:
        return Finding("photos", "ok", text)
    reasons = _listed(s.reason if s.name in s.reason else f"{s.name}: {s.reason}" for s in lost)
    advice = "Replace the files that cannot be read, or take them out of the folder"
    names = tuple(s.name for s in lost)
    return Finding("photos", "but", f"{text}; {len(lost)} skipped: {reasons}", advice, names)


def _copies(views: Views) -> list[Finding]:
    found = [s for s in views.skipped if s.copy_of]
    if not found:
        return []
    words = _listed(f"{s.name} is a {s.reason}" for s in found)
    text = f"{counted(len(found), 'photo')} counted once: {words}"
    return [Finding("copies", "note", text, "", tuple(s.name for s in found))]


def _sharpness(views: Views) -> Finding:
    weak = [views.items[i].source for i in blurred([v.sharpness for v in views.items])]
    if not weak:
        return Finding("sharpness", "ok", "no photo is far less sharp than the others")
    text = f"{counted(len(weak), 'photo')} far less sharp than the others: {_listed(weak)}"
    advice = "Take the blurred photos again: more light, a rest for the camera, focus on the object"
    return Finding("sharpness", "but", text, advice, tuple(weak))


def _exposure(look: Look, views: Views) -> list[Finding]:
    found = look.exposures
    said = {view.name: view.source for view in views.items}
    dark = [said[name] for name, one in found.items() if one.is_dark]
    white = [said[name] for name, one in found.items() if one.is_clipped]
    out = []
    if dark:
        text = f"{counted(len(dark), 'photo')} too dark to show much: {_listed(dark)}"
        advice = "Take the dark photos again with more light or a longer exposure"
        out.append(Finding("exposure", "but", text, advice, tuple(dark)))
    if white:
        text = (
            f"in {counted(len(white), 'photo')} more than {pixels.CLIPPED:.0%} of the pixels are "
            f"clipped to white: {_listed(white)}"
        )
        advice = "Expose less, so that only highlights are white"
        is_common = views.background != "photo" and len(white) > MANY * len(found)
        out.append(Finding("exposure", "but" if is_common else "note", text, advice, tuple(white)))
    stops = pixels.stops_apart(views)
    if stops is not None and stops > pixels.STOPS:
        text = f"the camera changed the exposure between photos, by up to {stops:.1f} stops"
        advice = "Fix the exposure. `run` evens photos that show the ground below the object"
        state: State = "note" if views.color_space == "linear" else "but"
        out.append(Finding("exposure", state, text, advice))
    return out or [Finding("exposure", "ok", "no photo is too dark or clipped")]


def _masks(views: Views) -> Finding:
    masked = sum(view.mask is not None for view in views.items)
    if not masked:
        text = "none: the object is looked for in the photos"
        return Finding("masks", "note", text, "Masks of the object make its outline more exact")
    bare = [view.source for view in views.items if view.mask is None]
    if bare:
        text = f"{counted(len(bare), 'photo')} without a mask: {_listed(bare)}"
        return Finding("masks", "but", text, "Add the missing masks, or use none", tuple(bare))
    return Finding("masks", "ok", "every photo has a mask")


def _other_warnings(look: Look) -> list[Finding]:
    texts = [text for text in look.warnings if not _TOLD.search(text)]
    return [Finding("reading", "but", text) for text in texts]


def light(views: Views) -> list[Finding]:
    """Whether the light moves with the camera, by what EXIF says of a flash."""
    told = [view.exif.flash for view in views.items]
    lit = [view.source for view, flash in zip(views.items, told, strict=True) if flash]
    if lit:
        text = (
            f"the flash fired in {len(lit)} of {counted(len(views.items), 'photo')}: the light "
            "moves with the camera. A lamp on the camera is fitted beside the room's light"
        )
        advice = "Switch the flash off and light the room instead; or expect weaker reflections"
        return [Finding("light", "but", text, advice, tuple(lit))]
    if any(flash is not None for flash in told):
        return [Finding("light", "ok", "no flash fired")]
    return [Finding("light", "ok", "EXIF does not say whether a flash fired")]


def _background(look: Look) -> list[Finding]:
    """A background that stands still while the object turns, and other notes of the placement."""
    notes = look.placement.notes if look.placement is not None else ()
    found = []
    for note in notes:
        turns = "stands still" in note
        advice = (
            "Light that turns with the object keeps its reflections in place: walk round the "
            "object instead, or expect weaker reflections"
        )
        name = "background" if turns else "placement"
        found.append(Finding(name, "but" if turns else "note", note, advice if turns else ""))
    return found


def _placement(look: Look) -> list[Finding]:
    if look.is_known:
        if look.model is None:
            advice = "Check the poses that came with the photos"
            return [Finding("placement", "bad", look.refused, advice)]
        count = counted(len(look.model.cameras), "pose")
        return [Finding("placement", "ok", f"{count} came with the photos; nothing to find")]
    judgement = look.judgement
    if judgement is None or look.views is None:
        return []
    said = {view.name: view.source or view.name for view in look.views.items}
    total, lost = len(look.tried), judgement.lost
    part = "" if total == len(look.views.items) else f" (of {len(look.views.items)}, evenly chosen)"
    photos = f"{counted(total, 'photo')}{part}"
    text = f"{total - len(lost)} of {photos} have a place that can be trusted"
    if lost:
        told = [f"{said[name]}: {why}" for name, why in lost.items()]
        text += f". {_listed(told)}"
    enough, *others = judgement.checks
    failed = [check for check in others if not check.is_met]
    state: State = "bad" if failed or not enough.is_met else "but" if lost else "ok"
    advice = "" if enough.is_met else enough.advice
    if state == "but":
        advice = "`run` looks harder for the places of the other photos; retake them if it fails"
    first = Finding("placement", state, text, advice, tuple(said[name] for name in lost))
    return [first, *(Finding(c.name, "bad", c.found, c.advice) for c in failed)]


def _coverage(look: Look) -> list[Finding]:
    """How much of the round trip the photos cover, and where they leave gaps."""
    whole = around(look.model) if look.model is not None else None
    if whole is None:
        return []
    gaps = look.judgement.gaps if look.judgement is not None else ()
    low, high = whole.heights
    text = (
        f"the widest stretch round the object without a photo is {whole.gap_deg:.0f} degrees; "
        f"photos from {low:.0f} to {high:.0f} degrees above its middle"
    )
    if not gaps and whole.gap_deg < GAP_DEG:
        return [Finding("coverage", "ok", text)]
    advice = "Take photos in the gaps, in steps of 10 to 15 degrees; what no photo shows is guessed"
    return [Finding("coverage", "but", "; ".join([text, *gaps]), advice)]


def _size(look: Look) -> Finding:
    scale = look.model.metres_per_unit if look.model is not None else None
    if scale is None and look.placement is not None:
        scale = look.placement.metres_per_unit
    if scale is not None:
        return Finding("size", "ok", "known from the photos")
    advice = "Give `run` the longest side, --size METRES, or lay the object on the printed mat"
    return Finding("size", "note", "unknown: nothing in the photos tells it", advice)


def _listed(texts: Iterable[str]) -> str:
    names = list(texts)
    more = f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
    return "; ".join(names[:NAMES_SHOWN]) + more
