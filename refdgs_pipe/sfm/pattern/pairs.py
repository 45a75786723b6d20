"""How much speaks for each way in which two photos of a repeating ground may lie on each other.

The cells of two photos lie as x_one = R x_other + shift, R a quarter turn that leaves the pattern
as it is, the shift whole cells beside a known offset. Two things are held against each other for
all of them: what does not repeat on the ground, and features beside it.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from refdgs_pipe.camera import F64
from refdgs_pipe.sfm.pattern.beside import Beside, agreeing, matches
from refdgs_pipe.sfm.pattern.cells import turn
from refdgs_pipe.sfm.pattern.topview import SIDE, TopView

F32 = NDArray[np.float32]
C64 = NDArray[np.complex64]

PADDED = 2 * SIDE
REACH = 24  # cells that one photo's middle may lie from the other's
SHIFTS = 2 * REACH + 1
GRID = np.stack(np.meshgrid(np.arange(SHIFTS), np.arange(SHIFTS)), -1)  # shifts from the least on
LEAST_OVERLAP = 12.0  # cells that both show
LEAST_PLACES = 50  # with such an overlap, that tell how much chance says
LEAST_SPREAD = 1.0  # of what chance says, as if the pixels had nothing to do with each other


@dataclass(frozen=True)
class Prepared:
    """A photo that is ready to be compared.

    Args:
        view: the ground from above, without what repeats; middle: (2,) of its cells.
        turned: quarter turns -> its values, where they are known, and their squares, in the
            Fourier domain.
    """

    view: TopView
    middle: F64
    beside: Beside
    turned: dict[int, tuple[C64, C64, C64]]


@dataclass(frozen=True)
class Evidence:
    """What speaks for each place of a photo's cells on another's.

    Args:
        start: quarter turns -> (2,) the least shift; the others are whole cells from there.
        table: quarter turns -> (SHIFTS, SHIFTS) rows y, columns x. Where only chance speaks for a
            place, the figures of a pair are about 0, their spread about 1.
    """

    start: dict[int, F64]
    table: dict[int, F32]

    def at(self, quarters: int, shifts: F64) -> F32:
        """(...) for shifts (..., 2) that lie at most half a cell beside those of the table."""
        if quarters not in self.table:
            return np.zeros(shifts.shape[:-1], np.float32)
        steps = np.round(shifts - self.start[quarters]).astype(int)
        inside = ((steps >= 0) & (steps < SHIFTS)).all(-1)
        steps = np.clip(steps, 0, SHIFTS - 1)
        return np.where(inside, self.table[quarters][steps[..., 1], steps[..., 0]], np.float32(0))


def starts(one: F64, other: F64, offsets: Mapping[int, F64]) -> dict[int, F64]:
    """Quarter turns -> (2,) the least shift of a table about the place where two middles meet.

    Args:
        one, other: (2,) the middles, cells.
        offsets: quarter turns -> (2,) what a shift is beside whole cells.
    """
    near = {k: one - turn(k) @ other - offset for k, offset in offsets.items()}
    return {k: offsets[k] + np.round(by) - REACH for k, by in near.items()}


def prepared(
    view: TopView, middle: F64, beside: Beside, turns: tuple[int, ...], threads: int
) -> Prepared:
    """A photo, ready to be compared after each of some quarter turns."""

    def of(a: F32) -> C64:
        return np.asarray(fft.rfft2(a, (PADDED, PADDED), workers=threads), np.complex64)

    turned = {}
    for k in turns:
        values, known = np.rot90(view.values, k), np.rot90(view.known, k)
        turned[k] = of(values), of(known), of(values * values)
    return Prepared(view, middle, beside, turned)


def evidence(one: Prepared, other: Prepared, offsets: Mapping[int, F64], threads: int) -> Evidence:
    """All ways in which the second photo may lie on the first.

    Args:
        offsets: quarter turns -> (2,) what the shift is beside whole cells.
    """
    start = starts(one.middle, other.middle, offsets)
    ground = _on_the_ground(one, other, start, threads)
    matched = matches(one.beside, other.beside)
    if matched is None:
        return Evidence(start, ground)
    counts = {
        k: agreeing(one.beside, other.beside, matched, k, GRID.reshape(-1, 2) + least)
        for k, least in start.items()
    }
    chance = float(np.mean([count.mean() for count in counts.values()]))
    for k, count in counts.items():
        ground[k] += (count.reshape(SHIFTS, SHIFTS) - chance) / np.sqrt(chance + 1)
    return Evidence(start, ground)


def _on_the_ground(
    one: Prepared, other: Prepared, start: dict[int, F64], threads: int
) -> dict[int, F32]:
    """Normalised correlation of the two views from above, each only where it is known
    (Padfield 2012), times the root of the overlap, by its spread over all places."""
    values, known, squares = one.turned[0]
    cell = one.view.cell

    def back(a: C64) -> F32:
        found = fft.irfft2(a, (PADDED, PADDED), workers=threads, overwrite_x=True)
        return np.asarray(found, np.float32)

    fits = {}
    for k, (v, m, s) in other.turned.items():
        overlap = back(known * m.conj())
        energy = back(squares * m.conj()) * np.maximum(back(known * s.conj()), 0)
        like = back(values * v.conj()) / np.sqrt(np.maximum(energy, 1.0))
        enough = overlap > LEAST_OVERLAP * cell**2
        fit = np.where(enough, like * np.sqrt(np.maximum(overlap, 0)), np.nan)
        moved = (GRID + start[k] - one.view.origin + turn(k) @ other.view.origin) * cell
        pixels = np.round(moved).astype(int)
        inside = (np.abs(pixels) < SIDE - 1).all(-1)
        best = np.full(inside.shape, np.nan, np.float32)
        for x in (-1, 0, 1):  # the lattices fit to about a pixel from above
            for y in (-1, 0, 1):
                near = (pixels + np.array([x, y])) % PADDED
                best = np.fmax(best, np.where(inside, fit[near[..., 1], near[..., 0]], np.nan))
        fits[k] = best
    said = np.concatenate([fit[np.isfinite(fit)] for fit in fits.values()])
    if len(said) < LEAST_PLACES:
        return {k: np.zeros_like(fit) for k, fit in fits.items()}
    spread = max(1.4826 * float(np.median(np.abs(said - np.median(said)))), LEAST_SPREAD)
    return {k: np.nan_to_num(fit / np.float32(spread), nan=0.0) for k, fit in fits.items()}
