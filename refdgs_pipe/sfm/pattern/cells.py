"""The cell that all photos of a repeating ground share.

Each photo's lattice begins anywhere in the pattern, and may step over half a period. The median
cell of all photos tells how each lattice has to be moved so that all begin at the same place of
the pattern, and which quarter turns leave the pattern as it is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64
from refdgs_pipe.sfm.pattern.lattice import Lattice
from refdgs_pipe.sfm.pattern.topview import (
    BASES,
    U8,
    cell_in_photo,
    cell_middle,
    gram,
    median_cell,
    refined,
    shortest,
)

SAME_SHAPE = 0.06  # of a cell's sides and their angle
SHOWS_IT = 0.85  # correlation of a photo's median cell with that of all photos
ONE_PERIOD = 0.8  # correlation of every other cell with the rest, where cells are one period
SYMMETRIC = 0.8  # correlation of the cell with itself after a quarter turn
SHAPES = 3  # of cells, the most common, that are tried for all photos
AS_ALIKE = 0.9  # times the most alike cells: then the smaller ones are taken
ROUNDS = 3
FINER = 8  # times: the grid that a shift between two cells is searched on


@dataclass(frozen=True)
class SharedCell:
    """What the lattices of some photos have in common. A photo is its number in the list.

    Args:
        lattices: photo -> its lattice, moved so that whole numbers are the same place of the
            pattern in each; photos that do not show the pattern are left out.
        median: (cell, cell) of their cells, mean 0; its middle lies at whole numbers.
        offsets: quarter turns that leave the pattern as it is -> (2,) cells. Two photos of one
            ground lie as x_one = R x_other + offset + whole numbers.
    """

    lattices: dict[int, Lattice]
    median: F64
    offsets: dict[int, F64]


def turn(quarters: int) -> F64:
    """(2, 2) what `np.rot90` does to x and y."""
    return np.asarray(np.linalg.matrix_power(np.array([[0.0, 1.0], [-1.0, 0.0]]), quarters % 4))


def shared_cell(
    lattices: Sequence[Lattice], greys: Sequence[U8], inverse: F64, cell: int
) -> SharedCell | None:
    """The cell that most photos show; None if no two photos show the same.

    Each of the most common shapes of a cell is tried for all photos. A shape that steps over half a
    period makes cells that differ; one of two periods makes cells that are larger than they need.

    Args:
        greys: (H, W) of each lattice's photo; inverse: (3, 3) of the intrinsics.
        cell: pixels of a cell from above.
    """
    grams = np.stack([_shape(one, inverse) for one in lattices])
    same = np.abs(grams[:, None] - grams[None]).max((2, 3)) < SAME_SHAPE
    tried, left = list[_Tried](), np.ones(len(lattices), bool)
    for _ in range(SHAPES):
        if not left.any():
            break
        middle = int((same & left).sum(1).argmax())
        members = np.flatnonzero(same[middle] & left)
        left &= ~same[middle]
        found = _tried(lattices, greys, inverse, cell, members, grams[middle])
        if found is not None:
            tried.append(found)
    if not tried:
        return None
    most = max(one.alike for one in tried)
    best = min((one for one in tried if one.alike > AS_ALIKE * most), key=lambda one: one.size)
    moved = {k: refined(one, greys[k], cell, best.template) for k, one in best.moved.items()}
    return SharedCell(moved, best.template, _symmetries(best.template))


@dataclass(frozen=True)
class _Tried:
    """A shape of a cell, tried for all photos.

    Args:
        moved: photo -> its lattice, begun at the same place of the pattern as the others'.
        alike: how sure it is that cells are one period, summed over the photos.
        size: pixels of a cell in the photos; template: (cell, cell) the median cell.
    """

    moved: dict[int, Lattice]
    alike: float
    size: float
    template: F64


def _tried(
    lattices: Sequence[Lattice],
    greys: Sequence[U8],
    inverse: F64,
    cell: int,
    members: NDArray[np.int64],
    shape: F64,
) -> _Tried | None:
    own = [median_cell(lattices[k], greys[k], cell) for k in members]
    shown = [one[0] for one in own if one is not None and one[1] > ONE_PERIOD]
    if not shown:
        return None
    template = _template(shown)
    moved, alike = {}, 0.0
    for k, lattice in enumerate(lattices):
        for there in _with_shape(lattice, inverse, shape):
            if there is not lattice:
                there = refined(there, greys[k], cell)
            seen = median_cell(there, greys[k], cell)
            like, shift = (0.0, np.zeros(2)) if seen is None else _shifted(template, seen[0])
            if seen is not None and seen[1] > ONE_PERIOD and like > SHOWS_IT:
                moved[k] = there.moved(shift - cell_middle(cell))
                alike += seen[1]
                break
    if len(moved) < 2:
        return None
    size = float(np.median([cell_in_photo(one) for one in moved.values()]))
    return _Tried(moved, alike, size, template)


def _with_shape(lattice: Lattice, inverse: F64, shape: F64) -> Iterator[Lattice]:
    """The lattice in other bases in which its cells have a shape (2, 2); first in its own."""
    if np.abs(_shape(lattice, inverse) - shape).max() < SAME_SHAPE:
        yield lattice
    for basis in BASES:
        there = lattice.in_basis(basis)
        there = there.in_basis(shortest(gram(there, inverse)))
        if np.abs(_shape(there, inverse) - shape).max() < SAME_SHAPE:
            yield there


def _shape(lattice: Lattice, inverse: F64) -> F64:
    """(2, 2) inner products of the basis vectors, the cell's area 1."""
    found = gram(lattice, inverse)
    return np.asarray(found / np.sqrt(max(float(np.linalg.det(found)), 1e-12)))


def _template(cells: list[F64]) -> F64:
    """(cell, cell) the median of the cells after they were moved onto each other."""
    template = cells[0]
    for _ in range(ROUNDS):
        template = np.median([_moved(one, _shifted(template, one)[1]) for one in cells], axis=0)
    return template


def _moved(values: F64, shift: F64) -> F64:
    """A cell (cell, cell) that repeats, moved by a shift (2,) in cells."""
    steps = np.fft.fftfreq(len(values)) * len(values)
    wave = np.exp(-2j * np.pi * (steps[None] * shift[0] + steps[:, None] * shift[1]))
    return np.asarray(np.fft.ifft2(np.fft.fft2(values) * wave).real)


def _shifted(one: F64, other: F64) -> tuple[float, F64]:
    """The correlation of two cells that repeat, and the shift (2,), cells, that the other needs."""
    side = len(one)
    product = np.fft.fft2(one) * np.conj(np.fft.fft2(other))
    wide = np.zeros((side * FINER, side * FINER), complex)
    half = side // 2
    rows = np.r_[0:half, -half:0]
    wide[np.ix_(rows, rows)] = product[np.ix_(rows, rows)]
    like = np.fft.ifft2(wide).real * FINER**2
    norm = float(np.linalg.norm(one) * np.linalg.norm(other))
    y, x = np.unravel_index(int(like.argmax()), like.shape)
    return float(like[y, x]) / max(norm, 1e-9), np.array([x, y], float) / (side * FINER)


def _symmetries(template: F64) -> dict[int, F64]:
    found = {quarters: _shifted(template, np.rot90(template, quarters)) for quarters in range(4)}
    return {quarters: shift for quarters, (like, shift) in found.items() if like > SYMMETRIC}
