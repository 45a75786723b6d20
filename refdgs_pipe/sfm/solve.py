"""The ladder: ways of placing photos, each tried where the last left some without a place."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from refdgs_pipe.artifacts.placement import Attempt, Placement, Poses
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.formatting import counted
from refdgs_pipe.mat.detection import Seen, seen_in_files
from refdgs_pipe.mat.layout import LINE_MM
from refdgs_pipe.sfm.mat_frame import Refused, mat_frame, sightings_in_poses
from refdgs_pipe.sfm.mat_pose import found_by_mat, placed_by_mat
from refdgs_pipe.sfm.pattern.places import ground_repeats, placed_by_pattern
from refdgs_pipe.sfm.pictures import MaskUse, Pictures, feature_masks
from refdgs_pipe.sfm.posed import shots_of
from refdgs_pipe.sfm.poses import Effort, Found
from refdgs_pipe.sfm.trust import standing

GOOD = 0.9  # share of photos trusted above which the slow rungs are not worth their time
HOPE = 0.25  # share of photos trusted below which adapting features will not reach enough
SLOW_FEATURES = 4096  # of a photo, on the rung that adapts each feature

_PATTERN = (
    "the ground repeats: the photos are placed by its pattern, and by what tells its repeats apart"
)

Run = Callable[[dict[str, Any]], Found]


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
    told: Callable[[int, int], None] = lambda done, total: None,
    line_mm: float = LINE_MM,
) -> Placement:
    """The placement of the attempt that placed most photos where they can be trusted.

    Around a still object the background helps, on a turntable it misleads: with `masks` "auto"
    everything counts at first, then only the object, then only the background. Rungs:
    as the settings say; the pattern of the ground, where it repeats; finer features; finer and
    fainter ones; the masks; and features adapted to steep views. Nothing follows a pattern that
    places more than the features before it.

    Args:
        run: calls `colmap.reconstruct` with these arguments, in a process of its own.
        told: hears how many pairs of photos were compared by the ground's pattern, of how many.
        line_mm: length of the printed mat's ruler line, as measured.
    """
    files = [f"{view.name}.png" for view in views.items]
    mat = seen_in_files(pictures.folder, files, threads=effort.threads)
    shots = shots_of(views, pictures.sizes)
    effort = effort.for_photos(pictures.sizes)
    so_far, repeats = _SoFar(len(views.items)), False
    for rung in _rungs(effort, masks, is_masked=views.background != "photo"):
        if not rung.only_from <= so_far.share < rung.only_below:
            continue
        poses, said = run(
            {
                "images": pictures.folder,
                "shots": shots,
                "masks": feature_masks(views, pictures, rung.use, scratch),
                "effort": rung.effort,
                "scratch": scratch / f"colmap-{rung.key}",
            }
        )
        is_first = not so_far.attempts
        so_far.keep(rung.name, found_by_mat(poses, mat, shots, line_mm=line_mm), said)
        if is_first and so_far.share < GOOD:
            alone = placed_by_mat(mat, shots, line_mm=line_mm)
            if alone is not None:
                so_far.keep("the printed mat alone", alone, ())
        if is_first and so_far.share < GOOD:
            repeats = ground_repeats(pictures.folder, shots, effort.threads)
            if repeats and not said:  # nothing is said of a background that stands still
                by_pattern = placed_by_pattern(pictures.folder, shots, effort.threads, told)
                if by_pattern is not None:
                    so_far.keep("the pattern of the ground", by_pattern, (_PATTERN,))
                    if so_far.best is by_pattern:
                        break  # features mislead on such a ground
    attempts = tuple(so_far.attempts)
    placement = Placement(so_far.best, attempts, so_far.notes, repeats=repeats)
    return placement if so_far.best is None else _measured(placement, so_far.best, mat, line_mm)


@dataclass
class _SoFar:
    """What has been tried, and the best of it."""

    total: int
    best: Poses | None = None
    notes: tuple[str, ...] = ()
    attempts: list[Attempt] = field(default_factory=list)

    @property
    def share(self) -> float:
        """Of the photos that have a trusted place."""
        return 0.0 if self.best is None else standing(self.best)[0] / self.total

    def keep(self, name: str, poses: Poses, notes: tuple[str, ...]) -> None:
        """Note an attempt; it becomes the best if it is."""
        rank = trusted, placed, points = standing(poses)
        self.attempts.append(Attempt(name, placed, trusted, points))
        if self.best is None or rank > standing(self.best):
            self.best, self.notes = poses, notes


def _measured(
    placement: Placement, poses: Poses, mat: dict[str, Seen], line_mm: float
) -> Placement:
    """The placement with size and up as the printed mat tells them, where photos show it."""
    if poses.mapper == "mat":
        up = np.array([0.0, 0.0, 1.0])
        return replace(placement, metres_per_unit=1.0, up=up)
    if poses.mapper == "pattern":
        return replace(placement, up=np.array([0.0, 0.0, 1.0]))
    frame = mat_frame(sightings_in_poses(poses, mat), line_mm=line_mm)
    if frame is None:
        return placement
    if isinstance(frame, Refused):
        said = f"the printed mat gives no size: {frame.reason}"
        return replace(placement, notes=(*placement.notes, said))
    said = (
        f"the printed mat gives size and up from {counted(frame.photos, 'photo')}: its corners fit "
        f"to {frame.residual_mm:.2f} mm ({frame.residual_percent:.2f} % of its width)"
    )
    notes = (*placement.notes, said)
    return replace(placement, metres_per_unit=frame.metres_per_unit, up=frame.up, notes=notes)


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
