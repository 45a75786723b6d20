"""The ladder: ways of placing photos, each tried where the last left some without a place."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from refdgs_pipe.artifacts.placement import Attempt, Placement, Poses
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.sfm.pictures import MaskUse, Pictures, feature_masks
from refdgs_pipe.sfm.posed import shots_of
from refdgs_pipe.sfm.poses import Effort
from refdgs_pipe.sfm.trust import standing

DOUBLED_UP_TO = 1000  # px: of smaller photos the finest features are most of what there is
GOOD = 0.9  # share of photos trusted above which the slow rungs are not worth their time
HOPE = 0.25  # share of photos trusted below which adapting features will not reach enough
SLOW_FEATURES = 4096  # of a photo, on the rung that adapts each feature

Run = Callable[[dict[str, Any]], tuple[Poses, tuple[str, ...]]]


@dataclass(frozen=True)
class Rung:
    """One way of placing photos.

    Args:
        name: in words; key: safe as a folder's name.
        only_below: share of photos trusted so far at which it is not tried any more.
        only_from: share of photos trusted so far under which it is not worth its time.
    """

    name: str
    key: str
    effort: Effort
    use: MaskUse
    only_below: float
    only_from: float = 0.0


def solve(
    views: Views,
    pictures: Pictures,
    effort: Effort,
    *,
    masks: MaskUse | Literal["auto"],
    scratch: Path,
    run: Run,
) -> Placement:
    """The placement of the attempt that placed most photos where they can be trusted.

    Around a still object the background helps, on a turntable it misleads: with `masks` "auto"
    everything counts at first, then only the object, then only the background. Rungs:
    as the settings say; finer features; finer and fainter ones; the masks; features adapted to
    steep views.

    Args:
        run: calls `colmap.reconstruct` with these arguments, in a process of its own.
    """
    total = len(views.items)
    if effort.first_octave is None:
        is_small = max(max(size) for size in pictures.sizes.values()) <= DOUBLED_UP_TO
        effort = replace(effort, first_octave=-int(is_small))
    best: Poses | None = None
    kept, notes, attempts = 0, tuple[str, ...](), list[Attempt]()
    for rung in _rungs(effort, masks, is_masked=views.background != "photo"):
        if kept >= rung.only_below * total or kept < rung.only_from * total:
            continue
        poses, said = run(
            {
                "images": pictures.folder,
                "shots": shots_of(views, pictures.sizes),
                "masks": feature_masks(views, pictures, rung.use, scratch),
                "effort": rung.effort,
                "scratch": scratch / f"colmap-{rung.key}",
            }
        )
        rank = count, placed, points = standing(poses)
        attempts.append(Attempt(rung.name, placed, count, points))
        if best is None or rank > standing(best):
            best, kept, notes = poses, count, said
    return Placement(best, tuple(attempts), notes)


def _rungs(effort: Effort, masks: MaskUse | Literal["auto"], *, is_masked: bool) -> Iterator[Rung]:
    """The ladder. Trust in every photo ends it, in 90 % of them the slow rungs."""
    first: MaskUse = "none" if masks == "auto" or not is_masked else masks
    finer = replace(effort, first_octave=-1)
    fainter = replace(finer, faint=True)
    slow = replace(fainter, affine=True, max_features=min(effort.max_features, SLOW_FEATURES))
    yield Rung("features as set", "first", effort, first, 1.0)
    if effort.first_octave != -1:
        yield Rung("finer features", "finer", finer, first, 1.0)
    yield Rung("finer and fainter features", "fainter", fainter, first, GOOD)
    if masks == "auto" and is_masked:
        yield Rung("features on the object only", "object", finer, "object", GOOD)
        yield Rung("features around the object only", "around", finer, "background", GOOD)
    yield Rung("features adapted to steep views", "affine", slow, first, GOOD, HOPE)
