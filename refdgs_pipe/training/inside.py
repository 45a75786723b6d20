"""What neighbouring photos see through the mouth of a vessel.

Photos from all sides do not agree on the colour of a polished inside, but photos from nearly one
direction do: reflections change little from one to the next. So the inside shows in the depths
that neighbours share. They also say how deep the vessel is, and what its floor looks like.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter, label

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.ops import Pinhole
from refdgs_pipe.training.ground import Surroundings
from refdgs_pipe.training.initial import Hull
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.stereo import DepthMap, depth_maps, small
from refdgs_pipe.training.vessels import Mouth, looking_in, shown

Bools = NDArray[np.bool_]
F32 = NDArray[np.float32]
Ints = NDArray[np.int64]

SAME = 1.0  # cells between a place and a depth that says that there is a surface
ROUND = 4  # cells round the hollow in which depths are asked
FREE = 2  # photos that have to see through a cell
MARGIN = 6  # pixels round the mouth that are compared as well
THIN = 1.5  # cells from the outside that stay
BLURS, ENOUGH = (2.0, 4.0, 8.0), 0.2  # cells over which votes are taken together; least votes
RIM = 0.05  # quantile of a lid's height that is its rim's: silhouettes bulge inside of it
LAYER = 1.5, 4.5  # cells below the rim, where an open mouth is empty
THROUGH = 0.33  # of the cells there, that photos see through, at least
RATHER = 2.5  # photos that see through such a cell, for each that sees a surface there or before


@dataclass(frozen=True)
class Inside:
    """What photos see through a mouth.

    Args:
        through: share of the cells a little below the rim that photos see through.
        rather: photos that see through them, for each that sees a surface there or before them.
        vessel: the hull without what photos look through, and without what they see nothing of.
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
    lid = np.zeros_like(hull.cells)
    places = (mouth.lid - hull.ball.center - hull.ticks[0]) / hull.cell
    lid[tuple(np.rint(places).astype(np.int64).T)] = True
    asked = hull.cells & binary_dilation(mouth.hollow | lid, iterations=ROUND)
    votes = np.zeros((3, *lid.shape), np.float32)
    points = hull.ball.center + hull.ticks[np.argwhere(asked)]
    votes[:, asked] = _votes(maps, points, SAME * hull.cell)
    free, filled = votes[0], votes[1] + votes[2]
    layer = mouth.hollow & _below_rim(hull, mouth.lid, model.up)
    if not layer.any():
        return None
    through = float(((free >= FREE) & (free >= filled))[layer].mean())
    rather = float(free[layer].sum() / max(1.0, float(filled[layer].sum())))
    empty = _majority(free, filled) & ~hull.on_ground(around)
    vessel = replace(hull, cells=_emptied(hull.cells, empty, lid))
    return Inside(through, rather, vessel)


def _below_rim(hull: Hull, lid: F64, up: F64) -> Bools:
    """(n, n, n) the cells a little lower than a mouth's rim, where silhouettes are right."""
    x, y, z = np.meshgrid(*hull.axes(), indexing="ij")
    under = float(np.quantile(lid @ up, RIM)) - (x * up[0] + y * up[1] + z * up[2])
    return np.asarray((under > LAYER[0] * hull.cell) & (under < LAYER[1] * hull.cell))


def _emptied(cells: Bools, empty: Bools, lid: Bools) -> Bools:
    """A solid without what is empty below its lid. Its walls stay, and loose parts of it go."""
    walls = distance_transform_edt(cells | binary_dilation(lid, iterations=ROUND)) <= THIN
    parts, _ = label((empty & cells & ~walls) | lid)
    reached = np.isin(parts, np.unique(parts[lid]))
    left, _ = label(cells & ~(reached & empty & ~walls))
    return np.asarray(left == 1 + int(np.bincount(left.ravel())[1:].argmax()))


def _majority(yes: F32, no: F32) -> Bools:
    """(n, n, n) where more votes are for than against; cells without votes follow those around."""
    share = np.zeros_like(yes)
    known = np.zeros(yes.shape, bool)
    for sigma in BLURS:
        one, other = gaussian_filter(yes, sigma), gaussian_filter(no, sigma)
        here = ~known & (one + other > ENOUGH)
        share[here] = (one / np.maximum(one + other, ENOUGH))[here]
        known |= here
    return np.asarray(share > 0.5)


def _part(photo: TrainingPhoto, lid: F64) -> TrainingPhoto | None:
    """The part of a photo that shows a lid (N, 3); None if it shows too little of it."""
    uv, depth = photo.camera.project(lid)
    if (depth <= 0).any():
        return None
    size = np.array([photo.camera.width, photo.camera.height])
    low = (np.floor(uv.min(0)).astype(int) - MARGIN).clip(0)
    high = np.minimum(np.ceil(uv.max(0)).astype(int) + MARGIN, size)
    if (high - low < 4 * MARGIN).any():
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


def _votes(maps: list[DepthMap], places: F64, same: float) -> tuple[Ints, Ints, Ints]:
    """For places (N, 3): photos that see something behind them, at them and before them."""
    counts = np.zeros((3, len(places)), np.int64)
    for seen in maps:
        uv, z = seen.camera.project(places)
        size = (seen.camera.width, seen.camera.height)
        within = (z > 0) & (uv >= 0).all(1) & (uv < size).all(1)
        column, row = np.where(within[:, None], uv, 0).astype(np.int64).T
        within &= seen.good[row, column]
        farther = seen.depth[row, column] - z
        counts[0] += within & (farther > same)
        counts[1] += within & (np.abs(farther) <= same)
        counts[2] += within & (farther < -same)
    return counts[0], counts[1], counts[2]
