"""The foot of the solid, at its contact with the plane, where mirrors show the plane itself."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from refdgs_pipe.camera import F64
from refdgs_pipe.ground.shots import Bools, Shot
from refdgs_pipe.masking.solid import KNOWN, REACH, SHOWN, Cells, Ints, polled

LOW = 0.06  # of the ball's radius: what lies lower is at the contact with the plane
BARELY = 0.09  # share of the photos that can tell, which may deny a cell at the contact
FOOT = 0.17  # of the ball's radius: as high up, mirrored ground may have taken a bite of the foot
BITE = 0.4  # of the ball's radius: wider gaps in the foot are no bites
HEARD = 0.75  # share of the votes on a cell that must remain without those for unproven ground
NARROW = 0.2  # of the ball's radius: narrower parts, such as legs, have no upright walls
RECEDES = 0.06  # of the ball's radius: what recedes further near the ground has no upright walls
UPRIGHT = 0.15  # share of the photos that may be heard, which may deny a cell below such a wall
AROUND = 4.0  # cells (sigma) over which that share is averaged


def low(cells: Cells, normal: F64, offset: float) -> Bools:
    """(n ** 3,) the cells at the contact with the plane normal . x = offset."""
    highest = LOW * _per_radius(cells) * cells.size
    return np.asarray(cells.inside & (cells.points @ normal - offset <= highest))


def heard_of(free: list[Bools], known: list[Bools], proven: list[Bools] | None) -> list[Bools]:
    """(H, W) where each photo can tell, but for ground that is not proven.

    Args:
        free, known: as in `covering`.
        proven: (H, W) where each photo would see ground whose texture photos from several sides
            agree on; None where that is not known: then all of what photos can tell is heard.
    """
    if proven is None:
        return known
    return [can & (may | sure) for may, can, sure in zip(free, known, proven, strict=True)]


def without_bites(
    cells: Cells,
    solid: Bools,
    shots: list[Shot],
    free: list[Bools],
    known: list[Bools],
    heard: list[Bools],
    plane: tuple[F64, float],
    *,
    deny: float,
) -> Bools:
    """(n ** 3,) the solid, and cells of its foot that are denied only by ground without proof.

    A mirror shows the ground in front of it, which by chance has the colour of the ground that
    would be seen if the mirror were not there. No photo ever sees that ground: it lies below the
    object, so photos from two sides never agree on its texture. Ground between legs they see.

    Args:
        solid, free, known: as in `covering`.
        heard: (H, W) as from `heard_of`.
        plane: unit normal and offset.
        deny: as in `agreed`.
    """
    height = cells.points @ plane[0] - plane[1]
    near = cells.inside & (height > 0) & (height <= FOOT * _per_radius(cells) * cells.size)
    index = np.flatnonzero(~solid & _enclosed(cells, solid, near, plane))
    index, seen, told, denied = polled(cells, index, shots, free, heard, deny)
    index, _, could, _ = polled(cells, index, shots, free, known, 1.0)
    enough = (seen >= SHOWN * len(shots)) & (told >= HEARD * could) & (told >= KNOWN * len(shots))
    out = solid.copy()
    out[index[enough & (denied <= deny * told)]] = True
    return out


def upright(
    cells: Cells,
    solid: Bools,
    shots: list[Shot],
    free: list[Bools],
    heard: list[Bools],
    plane: tuple[F64, float],
) -> Bools:
    """(n ** 3,) the solid, and cells below its walls, where these go straight down elsewhere.

    Near the ground, a wall mirrors the ground beside it, and some photos take it for that. So they
    take bites of the foot. A body whose walls go down to the ground along most of its outline has
    such walls along all of it, unless many photos deny that. What most of the outline recedes by,
    as a rounded edge does, stays free.

    Args:
        solid, free: as in `covering`; heard: (H, W) where each photo can tell, and may be heard.
        plane: unit normal and offset.
    """
    per_radius = _per_radius(cells)
    layers, top = _Layers(cells, plane, 4), round(FOOT * per_radius)
    walls = layers.plan(layers.rows(top, solid))
    walls = _wide(walls, max(3, round(NARROW * per_radius)) | 1)
    if not walls.any():
        return solid
    inwards = distance_transform_edt(walls)
    outline = walls & (inwards <= 1)
    asked = np.zeros(len(solid), bool)
    for layer in range(-1, top):
        below = layers.plan(layers.rows(layer, solid))
        if not below.any():
            continue
        recedes = float(np.median(distance_transform_edt(~below)[outline]))
        if recedes <= RECEDES * per_radius:
            rows = layers.rows(layer, cells.inside & ~solid)
            asked[rows] = layers.of((inwards > recedes) & ~below, rows)
    index, seen, told, denied = polled(cells, np.flatnonzero(asked), shots, free, heard, 1.0)
    sums = np.zeros((2, cells.n**3), np.float32)
    sums[0, index], sums[1, index] = denied / np.maximum(told, 1), 1
    around, count = (gaussian_filter(s.reshape((cells.n,) * 3), AROUND).ravel() for s in sums)
    back = around[index] <= UPRIGHT * count[index]
    back &= (seen >= SHOWN * len(shots)) & (told >= KNOWN * len(shots))
    out = solid.copy()
    out[index[back]] = True
    return out


def _wide(plan: Bools, width: int) -> Bools:
    """(H, W) the parts of a plan into which a disc fits, with their corners."""
    core = cv2.morphologyEx(plan.astype(np.uint8), cv2.MORPH_OPEN, _disc(width))
    return np.asarray(plan & (cv2.dilate(core, _disc(width)) > 0))


def standing(
    cells: Cells,
    solid: Bools,
    shots: list[Shot],
    free: list[Bools],
    known: list[Bools],
    plane: tuple[F64, float],
) -> Bools:
    """(n ** 3,) the solid, and cells between it and the plane that few photos deny.

    At the contact, a mirror shows the plane right beside the plane itself, and photos from one side
    take it for that. A solid that ends just above the plane stands on it.

    Args:
        solid, free, known: as in `covering`.
        plane: unit normal and offset.
    """
    near = low(cells, *plane)
    index = np.flatnonzero(near & ~solid)
    under = np.zeros(len(index), bool)
    lowest = solid & near
    for steps in range(1, cells.n):
        above, there = _at(cells, cells.points[index] + steps * cells.size * plane[0])
        there &= near[above]
        if not there.any():
            break
        under |= there & lowest[above]
    index = index[under]
    index, seen, told, denied = polled(cells, index, shots, free, known, BARELY)
    back = (seen >= SHOWN * len(shots)) & (told >= KNOWN * len(shots)) & (denied <= BARELY * told)
    out = solid.copy()
    out[index[back]] = True
    return out


class _Layers:
    """The cells in layers at even heights above the plane, each a plan of pixels as large as cells.

    Args:
        gap: pixels round the plans.
    """

    def __init__(self, cells: Cells, plane: tuple[F64, float], gap: int) -> None:
        normal, offset = plane
        a = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        a /= np.linalg.norm(a)
        flat = cells.points @ np.stack([a, np.cross(normal, a)], 1)
        self._place = np.rint((flat - flat.min(0)) / cells.size).astype(np.int64) + gap
        self._shape = tuple(self._place.max(0) + 1 + gap)
        self._layer = np.floor((cells.points @ normal - offset) / cells.size).astype(np.int64)

    def rows(self, layer: int, which: Bools) -> Ints:
        """The cells of a layer, of those that are asked for (n ** 3,)."""
        return np.flatnonzero(which & (self._layer == layer))

    def plan(self, rows: Ints) -> Bools:
        """(H, W) where some cells of one layer are; gaps of single cells are closed."""
        plan = np.zeros(self._shape, np.uint8)
        plan[tuple(self._place[rows].T)] = 1
        closed = cv2.morphologyEx(plan, cv2.MORPH_CLOSE, _disc(3))  # layers cut cells askew
        return np.asarray(closed > 0)

    def of(self, plan: Bools, rows: Ints) -> Bools:
        """(N,) what a plan has for some cells."""
        return np.asarray(plan[tuple(self._place[rows].T)])


def _enclosed(cells: Cells, solid: Bools, near: Bools, plane: tuple[F64, float]) -> Bools:
    """(n ** 3,) the cells of `near` in gaps of the solid, at their own height above the plane.

    A body that hangs over the ground all round has no gap at any height.
    """
    gap = max(3, round(BITE * _per_radius(cells))) | 1
    layers, out = _Layers(cells, plane, gap), np.zeros(len(solid), bool)
    for layer in range(int(np.ceil(FOOT * _per_radius(cells))) + 1):
        rows = layers.rows(layer, near)
        if len(rows):
            plan = layers.plan(layers.rows(layer, near & solid)).astype(np.uint8)
            out[rows] = layers.of(cv2.morphologyEx(plan, cv2.MORPH_CLOSE, _disc(gap)) > 0, rows)
    return out


def _disc(width: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width)), np.uint8)


def _per_radius(cells: Cells) -> float:
    """Cells along the ball's radius."""
    return cells.n / (2 * REACH)


def _at(cells: Cells, points: F64) -> tuple[Ints, Bools]:
    """(N,) rows of the cells that hold points (N, 3), and whether there are any."""
    steps = np.rint((points - cells.points[0]) / cells.size).astype(np.int64)
    there = ((steps >= 0) & (steps < cells.n)).all(1)
    x, y, z = np.where(there[:, None], steps, 0).T
    return (x * cells.n + y) * cells.n + z, np.asarray(there)
