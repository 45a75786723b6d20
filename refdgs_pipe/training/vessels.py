"""Vessels: whether a lid that silhouettes leave on an object is its top, or the mouth of a hollow.

Silhouettes close every hollow, also a bowl's. Photo agreement opens those whose inside is matte; a
polished inside agrees on nothing. `inside.py` and `seen_below.py` look for the inside of such a
vessel, each in another way.

A flat mirror deceives both: what it mirrors looks like the inside of a hollow. But photos that see
one place of the room mirrored in it agree on what they see, and photos of a hollow do not. Such a
lid stays closed. Silhouettes bulge on it as steeply as the lowest camera looks, so the bulge is cut
off.

If the lowest camera looks down steeply, silhouettes leave a roof on a flat top or on a mouth. It is
too steep for a lid, but no steeper than that camera looks. The level part below it is judged.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import (
    binary_closing,
    binary_dilation,
    distance_transform_edt,
    gaussian_filter,
    label,
    median_filter,
    minimum_filter,
)

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.mirrored import (
    STANDS_OUT,
    Agreement,
    Glimpse,
    Room,
    best_agreement,
    mirror_misfits,
)
from refdgs_pipe.training.carving import boundary
from refdgs_pipe.training.initial import F32, Hull
from refdgs_pipe.training.photos import TrainingPhoto

Bools = NDArray[np.bool_]

LEVEL = 0.75  # of the cosine between a lid's normal and up
LID = 0.1  # of the hull's boundary that a lid has, at least
RIM = 0.05  # quantile of a level part's height that is its rim's
FLAT = 0.12  # of its width: how far a lid may reach in height
WALL = 1.5  # cells that a vessel's walls are thick
HOLLOW = 0.15  # of the hull's cells that a hollow has, at least
DEEP = 3.0  # cells between the highest and the lowest of a hollow, at least
STILL_CLOSED = 0.6  # of the hollow's cells that photo agreement did not open
STEEP = np.radians(25.0)  # elevation of the lowest camera, from which on roofs are looked for
STEEPER = np.radians(5.0)  # by which a roof, made of cells, may be steeper than the camera looks
RISE = 2.0  # cells that a roof may be higher than this slope allows
ROOF = 0.95  # of the level part's columns: the least share on which a roof is no higher
LOOKS_IN = 0.3  # sine of the elevation from which a photo looks into a mouth
FEWEST = 8  # photos that look in
ALONG = 0.99  # cosine between up and an axis of the grid, for which level parts are looked for
DROP = 2.5  # cells to a neighbouring column, from which on a level part ends
PLATEAU = 0.25  # of the lid's columns, that the largest level part has, at least
A_MIRROR = 0.6  # `mirror_misfit` below which a level part is a flat mirror
ENOUGH = 50  # samples of a lid that other photos say something of
UNSHADED = 0.04  # spread of the colours of a plain flat top, by their median; a dome is shaded
PLAIN = 0.02  # spread of a lid's colours, sRGB, below which they tell nothing


@dataclass(frozen=True)
class Mouth:
    """A lid, and the hollow of a vessel below it.

    Args:
        lid: (N, 3) centres of the lid's cells, world.
        hollow: (n, n, n) the cells of the hollow, down to a floor as thick as the walls.
    """

    lid: F64
    hollow: Bools

    def is_closed(self, hull: Hull) -> bool:
        """Whether most of the hollow is filled in a hull that may be opened in part."""
        return bool((hull.cells & self.hollow).sum() >= STILL_CLOSED * self.hollow.sum())


def find_mouth(hull: Hull, up: F64, roof: float = 0.0) -> Mouth | None:
    """The largest level part of the hull's boundary; None if there is no large, flat one.

    Args:
        up: (3,) unit, world.
        roof: how steep the part may be in any case, radians.
    """
    shell = np.argwhere(boundary(hull.cells))
    normals = _normals(hull.cells)[tuple(shell.T)]
    upwards = normals @ up > min(LEVEL, float(np.cos(roof)))
    lid = np.zeros_like(hull.cells)
    lid[tuple(shell[upwards].T)] = True
    parts, count = label(lid, np.ones((3, 3, 3)))
    if not count:
        return None
    sizes = np.bincount(parts.ravel())[1:]
    lid = parts == 1 + int(sizes.argmax())
    top = hull.ball.center + hull.ticks[np.argwhere(lid)]
    if not _is_flat(top, up, max(FLAT, 0.5 * float(np.tan(roof)))):
        lid &= _as_high_as_rim(hull, top, up)
        top = hull.ball.center + hull.ticks[np.argwhere(lid)]
    if len(top) < LID * len(shell):
        return None
    reach = int(np.ceil(WALL)) + 2
    heights = hull.heights(up)
    above = heights > np.quantile(top @ up, RIM)
    capped = hull.cells | (binary_dilation(lid, iterations=reach) & above)
    deep = hull.cells & (distance_transform_edt(capped) > WALL)
    parts, _ = label(deep)
    below = binary_dilation(lid, iterations=2) & deep
    hollow = deep & np.isin(parts, np.unique(parts[below]))
    depth = np.ptp(heights[hollow]) if hollow.any() else 0
    if depth < DEEP * hull.cell or hollow.sum() < HOLLOW * hull.cells.sum():
        return None
    return Mouth(top, hollow)


def _is_flat(points: F64, up: F64, limit: float) -> bool:
    """Whether a level patch (N, 3) is thin: by its height beside its width."""
    height = points @ up
    low, high = np.quantile(height, [RIM, 1 - RIM])
    return bool(high - low < limit * _width(points, up))


def _width(points: F64, up: F64) -> float:
    """Of a level patch (N, 3), seen from above."""
    flat = points - (points @ up)[:, None] * up
    return 2 * float(np.linalg.norm(flat - flat.mean(0), axis=1).max())


def _as_high_as_rim(hull: Hull, top: F64, up: F64) -> Bools:
    """(n, n, n) cells about as high as the rim of a level patch (N, 3); none of a dome.

    What rises from a lid is no part of it, such as the root of a handle.
    """
    plateau = find_plateau(hull, top, up)
    if plateau is None:
        return np.zeros_like(hull.cells)
    above = hull.heights(up) - float((plateau.points @ up).mean())
    return np.asarray((above > -DROP * hull.cell) & (above < FLAT * _width(top, up)))


def _normals(cells: Bools) -> F32:
    """(n, n, n, 3) unit normals of the solid's smoothed boundary, outwards."""
    smooth = gaussian_filter(cells.astype(np.float32), 1.5)
    gradient = -np.stack(np.gradient(smooth), -1)
    length = np.linalg.norm(gradient, axis=-1, keepdims=True)
    return np.asarray(gradient / np.maximum(length, 1e-9), np.float32)


@dataclass(frozen=True, eq=False)
class Plateau:
    """The largest level part of a lid, as high as its border.

    Args:
        points: (N, 3) world, one for each column of the grid; normal: (3,) unit, up.
        bulge: (n, n, n) the cells of the hull above them.
        ball: that the object lives in.
    """

    points: F64
    normal: F64
    bulge: Bools
    ball: Ball


def find_plateau(hull: Hull, lid: F64, up: F64) -> Plateau | None:
    """The largest level part of a lid; None if up is no axis of the grid, or for a small part.

    Silhouettes are right at a part's border, where the surface drops. Inside they bulge, so no
    column of a part is higher than the highest one at its border.

    Args:
        lid: (N, 3) centres of the lid's cells, world; up: (3,) unit, world.
    """
    axis = int(np.abs(up).argmax())
    if abs(up[axis]) < ALONG:
        return None
    step = 1 if up[axis] > 0 else -1
    cells = np.moveaxis(hull.cells, axis, 2)[:, :, ::step]
    n = cells.shape[2]
    height = np.where(cells.any(2), n - 1 - np.argmax(cells[:, :, ::-1], axis=2), -n)
    border = (height >= 0) & (height - minimum_filter(height, 3) > DROP)
    level = np.full_like(height, -n)
    for h in range(n):
        parts, _ = label(height >= h)
        level[np.isin(parts, np.unique(parts[border & (height >= h)])) & (parts > 0)] = h
    columns = _columns(hull, lid, axis)
    at = level[tuple(columns.T)]
    counts = np.bincount(at[at >= 0], minlength=1)
    best = int(counts.argmax())
    if counts[best] < PLATEAU * len(columns):
        return None
    rows = columns[at == best]
    heights = np.full(len(rows), best if step > 0 else n - 1 - best)
    points = hull.ball.center + hull.ticks[np.insert(rows, axis, heights, axis=1)]
    above = np.zeros_like(cells)
    above[tuple(rows.T)] = np.arange(n) > best
    bulge = np.moveaxis((above & cells)[:, :, ::step], 2, axis)
    return Plateau(points, step * np.eye(3)[axis], bulge, hull.ball)


def _columns(hull: Hull, points: F64, axis: int) -> NDArray[np.int64]:
    """(M, 2) the columns of the grid along an axis, in which points (N, 3) lie."""
    return np.unique(np.delete(hull.cells_at(points), axis, axis=1), axis=0)


def find_roof(hull: Hull, cameras: Sequence[Camera], up: F64) -> Plateau | None:
    """The level part of the hull below a roof, which is the plateau's bulge.

    None if a camera looks from low, or if the bulge is steeper than silhouettes make a roof.
    """
    towards = np.stack([camera.center for camera in cameras]) - hull.ball.center
    sine = towards @ up / np.linalg.norm(towards, axis=1)
    lowest = float(np.arcsin(np.clip(sine.min(), -1, 1)))
    if lowest < STEEP:
        return None
    mouth = find_mouth(hull, up, lowest + STEEPER)
    plateau = None if mouth is None else find_plateau(hull, mouth.lid, up)
    if plateau is None or not _is_roof(hull, plateau, lowest + STEEPER):
        return None
    return plateau


def _is_roof(hull: Hull, plateau: Plateau, slope: float) -> bool:
    """Whether the bulge of a level part rises from its border, at most by `slope` (radians)."""
    axis = int(np.abs(plateau.normal).argmax())
    part = np.zeros((len(hull.ticks),) * 2, np.bool_)
    part[tuple(_columns(hull, plateau.points, axis).T)] = True
    inward = distance_transform_edt(np.pad(part, 1))[1:-1, 1:-1]  # cells from the border
    fits = plateau.bulge.sum(axis) <= RISE + np.tan(slope) * inward
    return bool(fits[part].mean() > ROOF)


def mirror_misfit(photos: Sequence[TrainingPhoto], plateau: Plateau) -> float | None:
    """By how much photos differ that see one direction mirrored if a level part is a flat mirror.

    Returns:
        Their mean difference by the spread of the part's colours, below A_MIRROR for a mirror; None
        where too few can be compared.
    """
    found, _ = _mirrored_in(photos, plateau)
    if found.count < ENOUGH or found.spread < PLAIN:
        return None
    return found.misfit / found.spread


def is_flat_top(photos: Sequence[TrainingPhoto], plateau: Plateau) -> bool:
    """Whether the level part under a roof is a flat mirror, or has one colour, without shading."""
    found, _ = _mirrored_in(photos, plateau)
    return bool(found.count >= ENOUGH and found.misfit < A_MIRROR * _scale(found))


def without_roof(hull: Hull, photos: Sequence[TrainingPhoto], plateau: Plateau) -> Bools:
    """(n, n, n) the hull's cells without the roof on a flat top.

    What stands on the top, such as a knob, keeps the roof above it: photos do not agree there on
    what the top would mirror.
    """
    normals = np.tile(plateau.normal, (len(plateau.points), 1))
    glimpses = [_glimpse(photo) for photo in photos]
    found, room = _mirrored_in(photos, plateau)
    misfits = mirror_misfits(plateau.points, normals, glimpses, near=np.inf, room=room)
    limit = STANDS_OUT * _scale(found)
    axis = int(np.abs(plateau.normal).argmax())
    stands = np.zeros((len(hull.ticks),) * 2, np.bool_)
    stands[tuple(_columns(hull, plateau.points[misfits > limit], axis).T)] = True
    stands = binary_dilation(median_filter(stands, 3))
    return np.asarray(hull.cells & ~(plateau.bulge & ~np.expand_dims(stands, axis)))


def _scale(found: Agreement) -> float:
    """What misfits of a flat top are compared with, sRGB: the spread of its colours, or noise."""
    return max(found.spread, UNSHADED * found.level)


def _mirrored_in(
    photos: Sequence[TrainingPhoto], plateau: Plateau
) -> tuple[Agreement, Room | None]:
    """How photos agree on what a level part would mirror, and the room where they agree best."""
    ball = plateau.ball
    return best_agreement(
        plateau.points,
        np.tile(plateau.normal, (len(plateau.points), 1)),
        [_glimpse(photo) for photo in photos],
        near=np.inf,
        center=ball.center,
        radius=ball.radius,
        enough=ENOUGH,
    )


def _glimpse(photo: TrainingPhoto) -> Glimpse:
    """A photo of a lid, which nothing hides, where the mask says that it shows the object."""
    assert photo.mask is not None
    color = np.asarray(photo.rgb.numpy().transpose(1, 2, 0) / 255, np.float32)
    return Glimpse(photo.camera, color, (photo.mask.numpy() > 127).astype(np.float32))


def looking_in(photos: Sequence[TrainingPhoto], mouth: Mouth, up: F64) -> NDArray[np.int64]:
    """The numbers of the photos that look into a mouth; none if they are fewer than FEWEST."""
    towards = np.stack([photo.camera.center for photo in photos]) - mouth.lid.mean(0)
    sine = towards @ up / np.linalg.norm(towards, axis=1)
    looks = np.flatnonzero(sine > LOOKS_IN)
    return looks if len(looks) >= FEWEST else looks[:0]


def shown(camera: Camera, points: F64) -> Bools:
    """(H, W) where a camera shows points (N, 3), without gaps between them."""
    uv, depth = camera.project(points)
    use = (depth > 0) & (uv >= 0).all(1) & (uv < (camera.width, camera.height)).all(1)
    out = np.zeros((camera.height, camera.width), np.bool_)
    column, row = uv[use].astype(np.int64).T
    out[row, column] = True
    return np.asarray(binary_closing(out, np.ones((5, 5), np.bool_)), np.bool_)
