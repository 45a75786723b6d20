"""A photo's view of the ground from above, without what repeats: stains, threads, shadows."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from refdgs_pipe.camera import F64
from refdgs_pipe.sfm.pattern.lattice import Lattice, mapped

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

SIDE = 360  # pixels of the view from above
SMALLER = 2.5  # times: a cell in it beside a cell in the photo
CELL_PX = (8, 40)
RIM = 6.0  # px of the photo's rim that are left out
LEAST_DENSE = 0.5  # of a pixel of the photo for a pixel from above, each way
LIKE_ITSELF = 0.6  # correlation of the ground with itself, below which nothing is told
TRUE_PERIOD = 0.8  # of the best correlation of the view with itself, one period on
AROUND = 2  # cells on each side that tell what repeats
LEAST_REPEATS = 5
FARTHER_CELLS = 6.0  # beyond the nodes, that may still be ground
WINDOW = 1.4  # cells, of a window that is held against the shared cell
GROUND = 0.6  # correlation with the shared cell, below which it is not the ground
OUTLIER = 4.0  # times the median deviation
CROWDED = 0.4  # of outliers around: it is the object
REFINED = 4  # times
SOFT = 1.0  # px from above, of the blur in which cells are held against each other
MORE_CELLS = 2.5  # that the ground grows each time
LEAST_CELLS = 8  # that look alike
LIKE_THE_REST = 0.7  # correlation with the median of all cells
FARTHEST_STEP = 0.2  # of a cell
FIT_PX = 0.7  # of a cell's middle from the homography
BASES = tuple(
    np.array(basis, float)
    for basis in (
        [[0.5, 0], [0, 0.5]],
        [[0.5, 0.5], [-0.5, 0.5]],
        [[0.5, 0], [0, 1]],
        [[1, 0], [0, 0.5]],
        [[1, 0], [0, 1]],
        [[1, 1], [-1, 1]],
        [[2, 0], [0, 1]],
        [[1, 0], [0, 2]],
        [[2, 0], [0, 2]],
    )
)  # columns, in found cells; a growth may step over nodes, or stand on half a period


@dataclass(frozen=True)
class TopView:
    """What does not repeat on the ground, seen from above.

    Args:
        values: (SIDE, SIDE) about -2 to 2, 0 where unknown; known: (SIDE, SIDE) 0 or 1.
        origin: (2,) cell in the middle; cell: pixels of a cell.
    """

    values: F32
    known: F32
    origin: F64
    cell: int


def settled(lattice: Lattice, grey: U8, gram_of: F64) -> Lattice:
    """The lattice in its shortest basis, its cell one period.

    Args:
        gram_of: (3, 3) inverse of the intrinsics: tells how long the basis vectors are.
    """
    cell = 12
    top, known = _from_above(lattice, grey, cell, np.round(np.median(lattice.nodes, axis=0)), 1.5)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), cell)
    level = cv2.GaussianBlur(np.where(known, top, 0), (0, 0), cell) / np.maximum(weight, 1e-3)
    top = top - level
    scores = []
    for basis in BASES:
        steps = np.round(basis.T * cell).astype(int)
        scores.append(min(_self_alike(top, known, step, cell) for step in steps))
    good = [b for b, s in zip(BASES, scores, strict=True) if s >= TRUE_PERIOD * max(scores)]
    told = max(scores) > LIKE_ITSELF
    least = min(good, key=lambda b: abs(float(np.linalg.det(b)))) if told else np.eye(2)
    found = lattice.in_basis(least)
    return found.in_basis(shortest(gram(found, gram_of)))


def refined(lattice: Lattice, grey: U8, cell: int, shared: F64 | None = None) -> Lattice:
    """The lattice with a node in each cell that looks like the others, and fitted to these.

    Each cell is moved onto the median of all cells (Lucas and Kanade 1981), and the homography is
    fitted to the moved cells. Done four times.

    Args:
        cell: pixels of a cell from above.
        shared: (cell, cell) the cell to move them onto instead, as `median_cell` gives it. The
            lattice has to fit it to a fraction of a cell; whole numbers become its middle.
    """
    for _ in range(REFINED):
        origin = np.round(np.median(lattice.nodes, axis=0))
        origin = origin if shared is None else origin - cell_middle(cell)
        top, known = _from_above(lattice, grey, cell, origin, MORE_CELLS)
        count = SIDE // cell
        rim = (SIDE - count * cell) // 2
        whole = _in_cells(known, cell).all(1)
        if whole.sum() < LEAST_CELLS:
            return lattice
        values = np.asarray(_in_cells(cv2.GaussianBlur(top, (0, 0), SOFT), cell)[whole], float)
        values -= values.mean(1, keepdims=True)
        mean = np.median(values, axis=0) if shared is None else _soft(shared).ravel()
        tiled = np.tile(mean.reshape(cell, cell), (3, 3))
        slopes = [g[cell : 2 * cell, cell : 2 * cell].ravel() for g in np.gradient(tiled)[::-1]]
        like = (
            values @ mean / np.maximum(np.linalg.norm(values, axis=1) * np.linalg.norm(mean), 1e-9)
        )
        J = np.stack(slopes, 1)
        gain = np.maximum((values @ mean) / max(float(mean @ mean), 1e-9), 0.2)
        steps = np.linalg.lstsq(J, (mean - values / gain[:, None]).T, rcond=None)[0].T
        good = (like > LIKE_THE_REST) & (np.abs(steps).max(1) < FARTHEST_STEP * cell)
        if good.sum() < LEAST_CELLS:
            return lattice
        row, column = np.divmod(np.flatnonzero(whole)[good], count)
        middle = np.stack([column, row], 1) * cell + rim + (cell - 1) / 2
        at = (middle - (SIDE - 1) / 2) / cell + origin
        pixels = mapped(lattice.pixels_from_cells, at + steps[good] / cell)
        nodes = np.round(at - at[0]) + origin if shared is None else np.round(at)
        fitted, _ = cv2.findHomography(nodes, pixels, cv2.RANSAC, FIT_PX)
        if fitted is None:
            return lattice
        off = np.linalg.norm(mapped(np.asarray(fitted, float), nodes) - pixels, axis=1)
        kept = off < 2 * FIT_PX
        lattice = Lattice(np.asarray(fitted, float), nodes[kept], pixels[kept])
    return lattice


def _soft(shared: F64) -> F64:
    """A cell (cell, cell) that repeats, as blurred as the views that it is held against."""
    return np.asarray(ndimage.gaussian_filter(shared, SOFT, mode="wrap"))


def _tiled(shared: F64) -> F64:
    """(SIDE, SIDE) the shared cell all over a view whose middle is a whole number."""
    cell = len(shared)
    rows = np.arange(SIDE) - (SIDE - 1) / 2 + (cell - 1) / 2
    where = np.stack(np.meshgrid(rows, rows, indexing="ij"))
    return np.asarray(ndimage.map_coordinates(shared, where, order=1, mode="grid-wrap"))


def _like(top: F32, known: NDArray[np.bool_], shared: F64) -> F64:
    """(SIDE, SIDE) correlation of a view with the shared cell in windows of about a cell."""
    cell, tiled = len(shared), _tiled(_soft(shared))
    window = (2 * (round(WINDOW * cell) // 2) + 1,) * 2
    weight = cv2.boxFilter(known.astype(np.float64), -1, window)

    def mean(a: NDArray[np.generic]) -> F64:
        total = cv2.boxFilter(np.where(known, a, 0).astype(np.float64), -1, window)
        return np.asarray(total / np.maximum(weight, 1e-6))

    one = np.asarray(cv2.GaussianBlur(top, (0, 0), SOFT), np.float64)
    spread = [mean(a * a) - mean(a) ** 2 for a in (one, tiled)]
    product = mean(one * tiled) - mean(one) * mean(tiled)
    return np.asarray(product / np.sqrt(np.maximum(spread[0] * spread[1], 1e-12)))


def _in_cells(a: NDArray[Any], cell: int) -> NDArray[Any]:
    """(count * count, cell * cell) the whole cells of a view (SIDE, SIDE), row by row."""
    count = SIDE // cell
    rim = (SIDE - count * cell) // 2
    inside = slice(rim, rim + count * cell)
    tiled = a[inside, inside].reshape(count, cell, count, cell).transpose(0, 2, 1, 3)
    return tiled.reshape(count**2, cell**2)


def median_cell(lattice: Lattice, grey: U8, cell: int) -> tuple[F64, float] | None:
    """(cell, cell) the median of a photo's cells, mean 0; and whether it is one period.

    Its middle lies at `cell_middle` beside whole numbers. The second figure is the least
    correlation between the median of every other cell and that of the rest, for columns, rows
    and both: low where a lattice steps over half a period. None if too few cells are seen whole.
    """
    origin = np.round(np.median(lattice.nodes, axis=0))
    top, known = _from_above(lattice, grey, cell, origin, 1.0)
    whole = _in_cells(known, cell).all(1)
    if whole.sum() < LEAST_CELLS:
        return None
    values = np.asarray(_in_cells(cv2.GaussianBlur(top, (0, 0), SOFT), cell)[whole], float)
    values -= values.mean(1, keepdims=True)
    row, column = np.divmod(np.flatnonzero(whole), SIDE // cell)
    alike = 1.0
    for odd in (row % 2 > 0, column % 2 > 0, (row + column) % 2 > 0):
        if min(odd.sum(), (~odd).sum()) >= LEAST_CELLS / 2:
            one, other = np.median(values[odd], axis=0), np.median(values[~odd], axis=0)
            norm = float(np.linalg.norm(one) * np.linalg.norm(other))
            alike = min(alike, float(one @ other) / max(norm, 1e-9))
    sharp = np.asarray(_in_cells(top, cell)[whole], float)
    sharp -= sharp.mean(1, keepdims=True)
    return np.asarray(np.median(sharp, axis=0).reshape(cell, cell)), alike


def cell_middle(cell: int) -> float:
    """Where the middle of a median cell lies, in cells beside a whole number, both ways."""
    rim = (SIDE - SIDE // cell * cell) // 2
    middle = (rim + (cell - 1) / 2 - (SIDE - 1) / 2) / cell
    return middle - round(middle)


def gram(lattice: Lattice, inverse: F64) -> F64:
    """(2, 2) inner products of the basis vectors on the plane, up to scale.

    Args:
        inverse: (3, 3) inverse of the intrinsics.
    """
    vectors = (inverse @ lattice.pixels_from_cells)[:, :2]
    return np.asarray(vectors.T @ vectors)


def cell_in_photo(lattice: Lattice) -> float:
    """Side of a cell in the photo, pixels, geometric mean, median over the nodes."""
    return float(np.sqrt(np.median(_density(lattice, lattice.nodes))))


def residual(lattice: Lattice, grey: U8, shared: F64) -> TopView:
    """What does not repeat.

    From each pixel the median of the same place in the cells around is taken away. What does not
    look like the shared cell is left out: it is the object.

    Args:
        lattice: whole numbers are the middle of the shared cell.
        shared: (cell, cell) what all cells look like, as `median_cell` gives it.
    """
    cell = len(shared)
    origin = np.round(np.median(lattice.nodes, axis=0))
    top, known = _from_above(lattice, grey, cell, origin, FARTHER_CELLS)
    known &= _like(top, known, shared) > GROUND
    value = np.where(known, top, np.nan)
    wide = np.pad(value, AROUND * cell, constant_values=np.nan)
    steps = range(0, 2 * AROUND * cell + 1, cell)
    repeats = np.stack(
        [
            wide[y : y + SIDE, x : x + SIDE]
            for i, y in enumerate(steps)
            for j, x in enumerate(steps)
            if (i + j) % 2 == 0 and (i, j) != (AROUND, AROUND)
        ]
    )
    known &= np.isfinite(repeats).sum(0) >= LEAST_REPEATS
    if not known.any():
        return TopView(np.zeros_like(top), known.astype(np.float32), origin, cell)
    rest = np.zeros_like(top)
    rest[known] = value[known] - np.nanmedian(repeats[:, known], axis=0)
    spread = max(1.5 * float(np.median(np.abs(rest[known]))), 1e-6)
    outlier = (np.abs(rest) > OUTLIER * spread) & known
    known &= cv2.boxFilter(outlier.astype(np.float32), -1, (cell, cell)) < CROWDED
    rest = np.where(known, np.clip(rest / spread, -2, 2), 0)
    weight = cv2.GaussianBlur(known.astype(np.float32), (0, 0), cell / 2)
    level = cv2.GaussianBlur(rest, (0, 0), cell / 2) / np.maximum(weight, 0.1)
    rest = np.where(known, rest - level, 0)
    return TopView(rest.astype(np.float32), known.astype(np.float32), origin, cell)


def _from_above(
    lattice: Lattice, grey: U8, cell: int, origin: F64, around: float
) -> tuple[F32, NDArray[np.bool_]]:
    """(SIDE, SIDE) logarithm of the photo's values, and where the photo shows them well.

    Args:
        around: cells beyond the hull of the nodes that still belong to the ground.
    """
    height, width = grey.shape
    steps = (np.arange(SIDE) - (SIDE - 1) / 2) / cell
    cells = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) + origin
    homogeneous = np.concatenate([cells, np.ones((len(cells), 1))], 1)
    depth = homogeneous @ lattice.pixels_from_cells[2]
    sign = np.sign(np.median(_depths(lattice)))
    x, y = mapped(lattice.pixels_from_cells, cells).T
    good = (depth * sign > 0) & (x > RIM) & (x < width - RIM) & (y > RIM) & (y < height - RIM)
    good &= _density(lattice, cells) > LEAST_DENSE**2 * cell**2
    shape = (SIDE, SIDE)
    ground = np.zeros(shape, np.uint8)
    corners = (lattice.nodes - origin) * cell + (SIDE - 1) / 2
    hull = cv2.convexHull(corners.astype(np.float32))
    cv2.fillConvexPoly(ground, np.round(hull).astype(np.int32), 1)
    reach = 2 * round(around * cell) + 1
    ground = np.asarray(cv2.dilate(ground, np.ones((reach, reach), np.uint8)))
    top = cv2.remap(
        np.log(grey.astype(np.float32) + 4),
        np.where(good, x - 0.5, 0).reshape(shape).astype(np.float32),
        np.where(good, y - 0.5, 0).reshape(shape).astype(np.float32),
        cv2.INTER_LINEAR,
    )
    return np.asarray(top, np.float32), np.asarray(good.reshape(shape) & (ground > 0))


def _depths(lattice: Lattice) -> F64:
    return np.asarray(
        lattice.nodes @ lattice.pixels_from_cells[2, :2] + lattice.pixels_from_cells[2, 2]
    )


def _density(lattice: Lattice, cells: F64) -> F64:
    """(n,) square pixels of the photo for a cell at these places."""
    depth = cells @ lattice.pixels_from_cells[2, :2] + lattice.pixels_from_cells[2, 2]
    determinant = abs(float(np.linalg.det(lattice.pixels_from_cells)))
    return np.asarray(determinant / np.maximum(np.abs(depth), 1e-9) ** 3)


def _self_alike(top: F32, known: NDArray[np.bool_], step: NDArray[np.int64], window: int) -> float:
    """Correlation of a view with itself, moved by a step (x, y), in windows; their median."""
    x, y = int(step[0]), int(step[1])
    rows = slice(max(y, 0), SIDE + min(y, 0)), slice(max(-y, 0), SIDE + min(-y, 0))
    columns = slice(max(x, 0), SIDE + min(x, 0)), slice(max(-x, 0), SIDE + min(-x, 0))
    one, other = (top[r, c].astype(np.float32) for r, c in zip(rows, columns, strict=True))
    both = known[rows[0], columns[0]] & known[rows[1], columns[1]]

    def mean(a: NDArray[np.generic]) -> F64:
        return np.asarray(cv2.boxFilter(np.asarray(a, np.float64), -1, (window, window)))

    whole = mean(both) > 0.999
    if whole.sum() < window:
        return -1.0
    means = mean(one), mean(other)
    spread = [mean(a * a) - m * m for a, m in zip((one, other), means, strict=True)]
    product = mean(one * other) - means[0] * means[1]
    like = product / np.sqrt(np.maximum(spread[0] * spread[1], 1e-12))
    return float(np.median(like[whole]))


def shortest(gram: F64) -> F64:
    """(2, 2) columns of the shortest basis (Gauss), in cells; the orientation stays, and the
    shorter vector comes first."""
    basis = np.eye(2)
    for _ in range(20):
        inner = basis.T @ gram @ basis
        if inner[0, 0] > inner[1, 1] * (1 + 1e-9):
            basis = np.stack([basis[:, 1], -basis[:, 0]], 1)
            continue
        times = round(float(inner[0, 1] / inner[0, 0]))
        if not times:
            break
        basis = np.stack([basis[:, 0], basis[:, 1] - times * basis[:, 0]], 1)
    return basis
