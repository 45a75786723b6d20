"""The solid that all masks agree on, as cells, and its silhouettes."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import F64
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import Bools, Shot

Ints = NDArray[np.int64]

REACH = 1.1  # radii of the ball that the cells cover
SHOWN = 0.6  # share of the photos that must show a cell
KNOWN = 0.2  # share of the photos that must know whether a cell is empty
DROP = 6  # photos after which cells that are lost are left out
DOUBTED = 0.5  # share of the photos that can tell, which may deny a cell that comes back
TIE = 0.05  # of that share: cells of one ray that differ by less are denied equally often
MUCH = 0.25  # of the solid's silhouette: a photo that is sure of more is not sure of the object
MOST = 0.06  # of the solid's cells that may come back: round a turntable photos are sure of more
# How many photos, at most, have to ask for a cell before none comes back: that many, or that share
FEWEST, OFTEN = 3, 0.1
SHADOW_CELLS = 256  # along an edge of the plane, on which shadows are drawn
PIECE = 0.03  # of the largest piece's cells: smaller ones go


@dataclass(frozen=True)
class Cells:
    """A grid of n cells along each axis around the ball.

    Args:
        points: (n ** 3, 3) centres, world.
        inside: (n ** 3,) which lie in the ball, and not below the plane.
        size: a cell's edge, world units.
    """

    n: int
    points: F64
    inside: Bools
    size: float


def grid(ball: Ball, normal: F64, offset: float, n: int) -> Cells:
    """Cells of the ball above the plane normal . x = offset."""
    size = 2 * REACH * ball.radius / n
    ticks = (np.arange(n) + 0.5) * size - REACH * ball.radius
    place = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    points = ball.center + place
    near = np.linalg.norm(place, axis=1) < REACH * ball.radius
    return Cells(n, points, near & (points @ normal - offset > -0.5 * size), size)


def ball_of(points: F64, cell: float) -> Ball:
    """A ball round points, a tenth and two cells larger than it has to be."""
    center = (points.min(0) + points.max(0)) / 2
    reach = float(np.linalg.norm(points - center, axis=1).max())
    return Ball(center, 1.1 * reach + 2 * cell)


def agreed(
    cells: Cells,
    shots: list[Shot],
    free: list[Bools],
    known: list[Bools],
    normal: F64,
    *,
    deny: float,
) -> Bools:
    """(n ** 3,) the cells that few photos deny, without small pieces.

    What no photo can tell of stays only above what is known to be solid.

    Args:
        free: (H, W) where each photo may show the object; known: (H, W) where it can tell.
        normal: (3,) unit, of the plane below.
        deny: share of the photos that can tell, which may deny a cell.
    """
    index = np.flatnonzero(cells.inside)
    index, seen, told, denied = polled(cells, index, shots, free, known, deny)
    points = cells.points[index]
    shown_enough = seen >= SHOWN * len(shots)
    sure = told >= KNOWN * len(shots)
    solid = shown_enough & sure & (denied <= deny * told)
    if solid.any():
        solid |= shown_enough & ~sure & (denied <= deny * told) & _above(points, solid, normal)
    out = np.zeros(len(cells.points), bool)
    out[index[solid]] = True
    return _without_crumbs(out, cells.n)


def covering(
    cells: Cells,
    solid: Bools,
    shots: list[Shot],
    free: list[Bools],
    known: list[Bools],
    sure: list[Bools],
    *,
    turns: bool = False,
) -> Bools:
    """(n ** 3,) the solid, and cells that come back because photos are sure to show something.

    A white rim before a white cloth is denied by photos from above, with little evidence. Photos
    that see it before a dark wall are sure of it: along each of their rays there is something,
    where the fewest photos deny it. If that makes too many cells, only those come back that two or
    more photos ask for.

    Args:
        solid: (n ** 3,) as from `agreed`; free, known: as there.
        sure: (H, W) where each photo is sure to show the object.
        turns: whether the object turned in a still room; then none come back if it is too many.
    """
    index = np.flatnonzero(cells.inside & ~solid)
    index, seen, told, denied = polled(cells, index, shots, free, known, DOUBTED)
    share = denied / np.maximum(told, 1)
    likely = (seen >= SHOWN * len(shots)) & (told >= KNOWN * len(shots)) & (share <= DOUBTED)
    index, share = index[likely], share[likely]
    points = cells.points[index]
    asked = np.zeros(len(index), np.int64)
    for shot, pixels in zip(shots, sure, strict=True):
        step = max(1, round(0.8 * pixels_of(cells.size, shot, cells.points.mean(0))))
        shown = silhouette(cells, solid, shot).astype(np.uint8)
        shown = cv2.dilate(shown, np.ones((2 * step + 1,) * 2, np.uint8))
        missing = pixels & (shown == 0)
        if missing.sum() > MUCH * np.count_nonzero(shown):
            continue
        bare = cv2.erode(missing.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rows, rays = _on_rays(points, shot, bare, step)
        least = np.full(rays.max(initial=0) + 1, np.inf)
        np.minimum.at(least, rays, share[rows])
        asked[np.unique(rows[share[rows] <= least[rays] + TIE])] += 1
    out = solid.copy()
    strictest = 1 if turns else max(FEWEST, round(OFTEN * len(shots)))
    for fewest in range(1, strictest + 1):
        back = asked >= fewest
        if back.sum() <= MOST * solid.sum():
            out[index[back]] = True
            break
    return out


def polled(
    cells: Cells, index: Ints, shots: list[Shot], free: list[Bools], known: list[Bools], deny: float
) -> tuple[Ints, Ints, Ints, Ints]:
    """The cells that may still be solid, and how many photos show, can tell of and deny each.

    Args:
        index: (N,) rows of the cells that are asked for; free, known, deny: as in `agreed`.
    """
    points = cells.points[index]
    seen, told, denied = (np.zeros(len(index), np.int64) for _ in range(3))
    for number, (shot, may, can) in enumerate(zip(shots, free, known, strict=True), 1):
        shown, tells, may_be = _asked(points, shot, may, can)
        seen += shown
        told += tells
        denied += tells & ~may_be
        if number % DROP == 0:  # what more photos cannot save
            left = (denied <= deny * len(shots)) & (number - seen <= (1 - SHOWN) * len(shots))
            index, points = index[left], points[left]
            seen, told, denied = seen[left], told[left], denied[left]
    return index, seen, told, denied


def _on_rays(points: F64, shot: Shot, pixels: Bools, step: int) -> tuple[Ints, Ints]:
    """Rows (M,) of the points that chosen pixels show, and numbers (M,) of rays `step` wide."""
    uv, depth = shot.camera.project(points)
    height, width = pixels.shape
    rows = np.flatnonzero((depth > 0) & (uv >= 0).all(1) & (uv < (width, height)).all(1))
    column, row = uv[rows].astype(np.int64).T
    chosen = pixels[row, column]
    rays = row // step * (width // step + 1) + column // step
    return rows[chosen], rays[chosen]


def _asked(points: F64, shot: Shot, may: Bools, can: Bools) -> tuple[Bools, Bools, Bools]:
    """(N,) whether a photo shows each point, can tell of it, and may show the object there."""
    uv, depth = shot.camera.project(points)
    left, _, top, _ = shot.box
    u, v = uv[:, 0] + left, uv[:, 1] + top
    shown = (depth > 0) & (u >= 0) & (v >= 0) & (u < shot.whole[0]) & (v < shot.whole[1])
    height, width = may.shape
    within = shown & (uv >= 0).all(1) & (uv < (width, height)).all(1)
    column, row = np.where(within[:, None], uv, 0).astype(np.int64).T
    tells = np.where(within, can[row, column], shown)
    return shown, tells, within & may[row, column]


def _above(points: F64, solid: Bools, normal: F64) -> Bools:
    """Which points lie over the round footprint of the solid ones."""
    flat = points - (points @ normal)[:, None] * normal
    middle = flat[solid].mean(0)
    reach = np.linalg.norm(flat - middle, axis=1)
    return np.asarray(reach <= np.quantile(reach[solid], 0.98))


def _without_crumbs(solid: Bools, n: int) -> Bools:
    pieces, count = label(solid.reshape(n, n, n))
    if count < 2:
        return solid
    sizes = np.bincount(pieces.ravel())[1:]
    kept = np.flatnonzero(sizes >= PIECE * sizes.max()) + 1
    return np.asarray(np.isin(pieces, kept).ravel())


def silhouette(cells: Cells, solid: Bools, shot: Shot) -> Bools:
    """(H, W) where a photo shows the solid."""
    height, width = shot.valid.shape
    out = np.zeros((height, width), np.uint8)
    uv, depth = shot.camera.project(cells.points[solid])
    use = (depth > 0) & (uv >= 0).all(1) & (uv < (width, height)).all(1)
    if not use.any():
        return out > 0
    column, row = uv[use].astype(np.int64).T
    out[row, column] = 1
    gap = int(np.ceil(0.65 * cells.size * shot.camera.K[0, 0] / float(depth[use].mean())))
    padded = np.pad(out, 2 * gap + 1)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((2 * gap + 1,) * 2, np.uint8))
    inner = slice(2 * gap + 1, -(2 * gap + 1))
    return np.asarray(closed[inner, inner] > 0)


def shadow(cells: Cells, solid: Bools, shot: Shot, ground: Ground, lamp: F64) -> Bools:
    """(H, W) where a photo may show the shadow that the solid throws on the plane, and a bit more.

    Args:
        lamp: (3,) in the camera's frame.
    """
    place = shot.camera.center + lamp @ shot.camera.cam_from_world[:3, :3]
    normal = np.cross(ground.a, ground.b)
    points = cells.points[solid]
    above, high = (points - ground.origin) @ normal, float((place - ground.origin) @ normal)
    below = above < 0.95 * high
    far = high / (high - above[below])
    flat = place + far[:, None] * (points[below] - place) - ground.origin
    x, y = (((flat @ side) / ground.radius + 1) / 2 * SHADOW_CELLS for side in (ground.a, ground.b))
    use = (x >= 0) & (y >= 0) & (x < SHADOW_CELLS) & (y < SHADOW_CELLS)
    picture = np.zeros((SHADOW_CELLS, SHADOW_CELLS), np.uint8)
    if not use.any():
        return np.zeros(shot.valid.shape, np.bool_)
    picture[y[use].astype(int), x[use].astype(int)] = 1
    step = 2 * ground.radius / SHADOW_CELLS
    gap = int(np.ceil(float(far[use].max()) * cells.size / step))
    kernel = np.ones((2 * gap + 1, 2 * gap + 1), np.uint8)
    picture = cv2.dilate(picture, kernel)  # closes the gaps between cells, and widens by one
    return np.asarray(ground.drawn(picture.astype(np.float32), shot.camera, 0.0) > 0.1)


def pixels_of(length: float, shot: Shot, center: F64) -> float:
    """How many pixels a length at the object spans."""
    distance = float(np.linalg.norm(shot.camera.center - center))
    return float(length * shot.camera.K[0, 0] / distance)
