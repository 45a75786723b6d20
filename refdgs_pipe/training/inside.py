"""What neighbouring photos see through the mouth of a vessel.

Photos from all sides do not agree on the colour of a polished inside, but photos from nearly one
direction do: reflections change little from one to the next. So the inside shows in the depths
that neighbours share. Single depths are wrong where reflections do move. But most of those of one
height say whether it lies above the floor, so they tell how deep the vessel is.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.ops import Pinhole
from refdgs_pipe.training.ground import Surroundings
from refdgs_pipe.training.initial import Hull
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.stereo import DepthMap, depth_maps, small
from refdgs_pipe.training.vessels import Mouth, looking_in, shown

Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

SAME = 1.0  # cells between a place and what is behind it, to be seen through
FREE = 2  # photos that have to see through a cell
MARGIN = 6  # pixels round the mouth that are compared as well
LEAST_SIDE = 24  # pixels of a photo's part, on either side
RIM = 0.05  # quantile of a lid's height that is its rim's: silhouettes bulge inside of it
LAYER = 1.5, 4.5  # cells below the rim, where an open mouth is empty
THROUGH = 0.33  # of the cells there, that photos see through, at least
RATHER = 4.0  # photos that see through such a cell, for each that does not
CLEAR = 1.0  # cells from the walls of the hollow, where cells of this layer are asked
CORE = 3.0  # cells from the walls of the hollow, where its floor is looked for
ENOUGH = 30  # photos that tell of the cells of one layer, all together


@dataclass(frozen=True)
class Inside:
    """What photos see through a mouth.

    Args:
        through: share of the cells a little below the rim that photos see through.
        rather: photos that see through them, for each that does not.
        vessel: the hull with walls of even thickness, and the floor that photos see.
    """

    through: float
    rather: float
    vessel: Hull

    @property
    def opens(self) -> bool:
        """Whether photos clearly look through the mouth."""
        return self.through >= THROUGH and self.rather >= RATHER

    @property
    def words(self) -> str:
        """Both figures, for people."""
        return f"photos see through {self.through:.0%} of it ({self.rather:.1f} to 1)"


def see_inside(
    model: SparseModel,
    photos: list[TrainingPhoto],
    hull: Hull,
    mouth: Mouth,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Inside | None:
    """Look for a vessel's inside in photos from above its mouth; None for too few of them.

    Args:
        hull: the solid that the mouth belongs to.
        threads: photos that are worked on at a time; the result does not depend on it.
        progress: told the photos done and their number; may raise.
    """
    looks = looking_in(photos, mouth, model.up)
    chosen = [part for i in looks if (part := _part(small(photos[i]), mouth.lid)) is not None]
    if not chosen:
        return None

    def limits(camera: Camera) -> tuple[float, float]:
        depth = float(camera.cam_from_world[2] @ np.append(hull.ball.center, 1.0))
        return max(depth - hull.ball.radius, 0.2 * depth), depth + hull.ball.radius

    around = Surroundings(model, ground=True)
    maps = depth_maps(chosen, hull.ball.center, limits, threads, progress)
    maps = [_above(found, mouth.lid, around) for found in maps]
    asked = np.argwhere(mouth.hollow)
    places = hull.ball.center + hull.ticks[asked]
    free, filled = _votes(maps, places, SAME * hull.cell)
    under = (float(np.quantile(mouth.lid @ model.up, RIM)) - places @ model.up) / hull.cell
    walls = distance_transform_edt(mouth.hollow)[tuple(asked.T)]
    layer = (under > LAYER[0]) & (under < LAYER[1]) & (walls > CLEAR)
    if not layer.any():
        return None
    through = float(((free >= FREE) & (free >= filled))[layer].mean())
    rather = float(free[layer].sum() / max(1, filled[layer].sum()))
    core = walls > CORE
    above = under < _floor(under[core], free[core], filled[core]) + SAME
    gone = np.zeros_like(hull.cells)
    gone[tuple(asked[above].T)] = True
    vessel = replace(hull, cells=hull.cells & ~(gone & ~hull.on_ground(around)))
    return Inside(through, rather, vessel)


def _floor(under: F64, free: Ints, filled: Ints) -> float:
    """How many cells below the rim a vessel's floor lies; infinity where photos do not tell.

    Args:
        under: (N,) cells below the rim, of places in the middle of the hollow.
        free, filled: (N,) photos that see through them, and those that do not.
    """
    layers = np.floor(under).astype(np.int64)
    for layer in range(max(0, int(layers.min(initial=0))), int(layers.max(initial=-1)) + 1):
        at = layers == layer
        votes = int(free[at].sum() + filled[at].sum())
        if votes >= ENOUGH and free[at].sum() < 0.5 * votes:
            return float(layer)
    return np.inf


def _part(photo: TrainingPhoto, lid: F64) -> TrainingPhoto | None:
    """The part of a photo that shows a lid (N, 3); None if it shows too little of it."""
    uv, depth = photo.camera.project(lid)
    if (depth <= 0).any():
        return None
    size = np.array([photo.camera.width, photo.camera.height])
    low = (np.floor(uv.min(0)).astype(int) - MARGIN).clip(0)
    high = np.minimum(np.ceil(uv.max(0)).astype(int) + MARGIN, size)
    if (high - low < LEAST_SIDE).any():
        return None
    move = np.eye(3)
    move[:2, 2] = -low
    (left, top), (width, height) = low, (int(side) for side in high - low)
    camera = replace(photo.camera, width=width, height=height, K=move @ photo.camera.K)
    here = replace(photo, camera=camera, pinhole=Pinhole.of(camera, photo.pinhole.near), held=None)
    return here.each(lambda pixels: pixels[..., top : top + height, left : left + width])


def _above(found: DepthMap, lid: F64, around: Surroundings) -> DepthMap:
    """Only what is seen through a lid (N, 3), above the ground: what lies lower is mirrored."""
    points = torch.from_numpy(found.points().reshape(-1, 3))
    high = around.above(points).numpy().reshape(found.depth.shape)
    return replace(found, good=found.good & high & shown(found.camera, lid))


def _votes(maps: list[DepthMap], places: F64, same: float) -> tuple[Ints, Ints]:
    """For places (N, 3): photos that see something behind them, and those that see none there.

    Args:
        same: world units; what is no farther behind a place is taken for a surface there.
    """
    free, filled = np.zeros((2, len(places)), np.int64)
    for seen in maps:
        uv, z = seen.camera.project(places)
        size = (seen.camera.width, seen.camera.height)
        within = (z > 0) & (uv >= 0).all(1) & (uv < size).all(1)
        column, row = np.where(within[:, None], uv, 0).astype(np.int64).T
        within &= seen.good[row, column]
        behind = seen.depth[row, column] - z > same
        free += within & behind
        filled += within & ~behind
    return free, filled
