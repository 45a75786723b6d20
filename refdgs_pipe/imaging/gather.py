"""The photos that could be read become one set, or the reasons why they cannot."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from refdgs_pipe.artifacts.capture import WHAT_IS_READ, Frame
from refdgs_pipe.artifacts.views import Background, ColorSpace, KnownPoints, Skipped, View, Views
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.imaging.quality import blurred

MIN_PHOTOS = 3
MIN_FOR_HOLDOUT = 16
NAMES_SHOWN = 6


def gather_views(
    results: Sequence[View | Skipped],
    frames: Sequence[Frame],
    *,
    folder: Path,
    linear: bool,
    holdout: int,
    from_first: bool = False,
    points: KnownPoints | None,
) -> Views:
    """One set of views from what became of each frame.

    Args:
        holdout: every so many-th photo becomes a test view; 0 for none.
        from_first: whether the first photo is one, or that in the middle of the first gap.

    Raises:
        CaptureError: fewer than three are usable.
    """
    items = [result for result in results if isinstance(result, View)]
    skipped = tuple(result for result in results if isinstance(result, Skipped))
    if len(items) < MIN_PHOTOS:
        raise CaptureError(_too_few(items, skipped))
    if holdout and len(items) >= MIN_FOR_HOLDOUT:
        first = 0 if from_first else holdout // 2
        splits = ["test" if i % holdout == first else "train" for i in range(len(items))]
        items = [replace(item, split=s) for item, s in zip(items, splits, strict=True)]
    drawn = any(frame.mask is not None and frame.mask_kind == "drawn" for frame in frames)
    masked = sum(item.mask is not None for item in items)
    background: Background = "photo"
    if masked:
        background = "removed" if masked == len(items) and not drawn else "masked"
    space: ColorSpace = "linear" if linear else "srgb"
    return Views(folder, tuple(items), space, background, skipped, points)


def warnings_about(views: Views, *, inverted_masks: bool) -> list[str]:
    """What the user should know about a set: skipped and blurred photos, odd masks."""
    total = len(views.items) + len(views.skipped)
    notes = []
    copies = [f"{s.name} ({s.reason})" for s in views.skipped if s.copy_of]
    if copies:
        are = "file is a copy" if len(copies) == 1 else "files are copies"
        notes.append(f"{len(copies)} {are} of other photos and left out: {listed(copies)}")
    damaged = [s for s in views.skipped if not (s.harmless or s.copy_of)]
    if damaged:
        notes.append(f"{len(damaged)} of {total} files skipped: {listed(_reasons(damaged))}")
    weak = [views.items[i].source for i in blurred([v.sharpness for v in views.items])]
    if weak:
        notes.append(f"{len(weak)} photos look blurred next to the others: {listed(weak)}")
    unmasked = [view.source for view in views.items if view.mask is None]
    if views.background == "masked" and unmasked:
        notes.append(f"{len(unmasked)} photos have no mask: {listed(unmasked)}")
    if inverted_masks:
        notes.append("the masks mark the object in black; they are read the other way round")
    return notes


def figures_of(views: Views) -> dict[str, int | str]:
    """What is measured of a set: counts of photos and of skipped ones, colours, background."""
    return {
        "photos": len(views.items),
        "skipped": sum(not file.harmless for file in views.skipped),
        "colour space": views.color_space,
        "background": views.background,
    }


def _too_few(items: Sequence[View], skipped: Sequence[Skipped]) -> str:
    photos = "1 usable photo" if len(items) == 1 else f"{len(items)} usable photos"
    advice = "30 to 100 photos from all around the object work well"
    if not skipped:
        return f"found {photos}, at least {MIN_PHOTOS} are needed; {advice}"
    if not items and all(s.harmless for s in skipped):
        names = listed([s.name for s in skipped])
        return f"none of the {len(skipped)} files is a photo ({names}). {WHAT_IS_READ}"
    return f"found {photos}, at least {MIN_PHOTOS} are needed. {listed(_reasons(skipped))}"


def _reasons(skipped: Sequence[Skipped]) -> list[str]:
    """Each reason with the file's name, unless it names the file itself."""
    return [
        s.reason if s.name.split("/")[-1] in s.reason else f"{s.name}: {s.reason}" for s in skipped
    ]


def listed(texts: Sequence[str]) -> str:
    """The first few texts and how many more there are, in one line."""
    more = f"; and {len(texts) - NAMES_SHOWN} more" if len(texts) > NAMES_SHOWN else ""
    return "; ".join(texts[:NAMES_SHOWN]) + more
