"""Where surfels start: in the masks, where a first look finds the object, or on a stereo cloud."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.training.ground import Surroundings
from refdgs_pipe.training.initial import Hull, closed_hull, object_hull
from refdgs_pipe.training.look import look
from refdgs_pipe.training.photos import TrainingPhoto, load_training_photos
from refdgs_pipe.training.seen_below import seen_below
from refdgs_pipe.training.settings import StartParams
from refdgs_pipe.training.starting import Given, start_of
from refdgs_pipe.training.step import near_of
from refdgs_pipe.training.stereo_start import agreed_cloud
from refdgs_pipe.training.vessels import (
    A_MIRROR,
    Mouth,
    find_mouth,
    find_plateau,
    find_roof,
    is_flat_top,
    mirror_misfit,
    without_roof,
)


@dataclass(frozen=True)
class Begun:
    """A start.

    Args:
        stereo: whether it lies on what neighbouring photos agree on.
        top: what was found out of its level top, in words; empty if it has none.
    """

    start: Start
    stereo: bool
    top: str = ""


@dataclass(frozen=True)
class _Solid:
    """The object within its masks.

    Args:
        top: what was found out of its level top, in words; empty if it has none.
        hollow: (n, n, n) cells of a vessel's inside, if it is one.
    """

    hull: Hull | None
    top: str = ""
    hollow: NDArray[np.bool_] | None = None


def begin(
    views: Views,
    model: SparseModel,
    params: StartParams,
    scratch: Path,
    *,
    device: str = "cpu",
    photos: list[TrainingPhoto] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Begun:
    """Look for where surfels start. What a look or stereo found stays in `scratch`.

    Args:
        device: where a first look is computed, "cpu" or "cuda".
        photos: those of the views, if they are in memory already.
        progress: told the steps done and their number; may raise.

    Raises:
        TrainingError: no view is left to train on.
    """
    near = near_of(model)
    if photos is None:
        photos = load_training_photos(views, model, max_side=params.max_side, near=near)
    masked = views.background != "photo"
    if masked:
        solid = _solid(params, model, photos, progress)
        given = Given(params, model, photos, hull=solid.hull, hollow=solid.hollow)
        return Begun(start_of(given, masked=True), False, solid.top)
    agreed = agreed_cloud(params, model, photos, scratch, progress)
    if agreed is not None or params.look_steps == 0:
        given = Given(params, model, photos, agreed=agreed, progress=progress)
        return Begun(start_of(given, masked=False), agreed is not None)
    seen = look(params, model, photos, scratch, near=near, device=device, progress=progress)
    given = Given(
        params,
        model,
        seen.photos,
        behind=seen.background,
        covers=seen.covers,
        random=seen.random,
        progress=progress,
    )
    return Begun(start_of(given, masked=False), False)


def _solid(
    params: StartParams,
    model: SparseModel,
    photos: list[TrainingPhoto],
    progress: Callable[[int, int], None] | None,
) -> _Solid:
    """The object within its masks, and what was found out of its level top.

    It is a vessel if photos see through its lid, or agree better on a vessel's inside. The bulge
    on a flat mirror is gone, and so is the roof that silhouettes leave on a flat top or a vessel.
    """
    if params.masked == "ball" or any(photo.mask is None for photo in photos):
        return _Solid(None)
    closed = closed_hull(model, photos)
    if closed is None:
        return _Solid(None)
    hull = object_hull(params, model, photos, progress, closed=closed)
    if hull is None or params.masked != "carved" or not params.vessels:
        return _Solid(hull)
    mouth = find_mouth(closed, model.up)
    roof = None
    if mouth is None:
        roof = find_roof(closed, [photo.camera for photo in photos], model.up)
    if roof is not None:
        closed = replace(closed, cells=closed.cells & ~roof.bulge)
        mouth = find_mouth(closed, model.up)
    if mouth is None or not mouth.is_closed(hull):
        return _Solid(hull)
    if roof is not None and is_flat_top(photos, roof):
        flat = replace(hull, cells=hull.cells | mouth.hollow)
        flat = replace(flat, cells=without_roof(flat, photos, roof))
        return _Solid(flat, "flat, below the roof that silhouettes leave")
    return _opened(model, photos, closed, hull, mouth, progress)


def _opened(
    model: SparseModel,
    photos: list[TrainingPhoto],
    closed: Hull,
    hull: Hull,
    mouth: Mouth,
    progress: Callable[[int, int], None] | None,
) -> _Solid:
    """The solid, flat or opened below its lid if photos say so.

    Args:
        closed: the visual hull, without a roof above the lid; hull: of `object_hull`.
    """
    plateau = find_plateau(closed, mouth.lid, model.up)
    misfit = None if plateau is None else mirror_misfit(photos, plateau)
    if plateau is not None and misfit is not None and misfit < A_MIRROR:
        level = closed.cells & ~plateau.bulge
        flat = replace(hull, cells=(hull.cells | mouth.hollow) & level)
        return _Solid(flat, f"a flat mirror, misfit {misfit:.2f}")
    from refdgs_pipe.training.inside import see_inside  # needs OpenCV; a GPU machine may lack it

    told = "" if misfit is None else f", misfit as a flat mirror {misfit:.2f}"
    seen = see_inside(model, photos, closed, mouth, torch.get_num_threads(), progress)
    if seen is not None and seen.opens:
        vessel = replace(hull, cells=hull.cells & seen.vessel.cells)
        return _Solid(vessel, seen.words + told, mouth.hollow & ~vessel.cells)
    if plateau is None:  # a dome
        return _Solid(hull)
    grounded = hull.on_ground(Surroundings(model, ground=True))
    solid = replace(hull, cells=hull.cells & closed.cells)
    below = seen_below(photos, closed, solid, mouth, plateau, grounded, progress)
    if below is None:
        return _Solid(hull)
    if not below.opens:
        return _Solid(hull, below.words + told)
    return _Solid(below.vessel, below.words + told, mouth.hollow & ~below.vessel.cells)
