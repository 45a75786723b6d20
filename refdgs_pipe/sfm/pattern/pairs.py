"""Two views of a repeating ground laid on each other by what does not repeat on it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from refdgs_pipe.camera import F64
from refdgs_pipe.sfm.pattern.topview import SIDE, TopView

C64 = NDArray[np.complex64]

PADDED = 2 * SIDE
LEAST_OVERLAP = 12.0  # cells that both show
DECIDES = 1.3  # times the second best fit, that the best one has to reach
BESIDE = 3  # px round the best fit that are not another fit


@dataclass(frozen=True)
class Overlay:
    """How the second of two photos lies on the first.

    Args:
        turns: quarter turns of its cells; shift: (2,) cells: x_one = R x_other + shift.
        fit: correlation times the root of the pixels that both show; ratio: to the next best.
    """

    turns: int
    shift: F64
    fit: float
    ratio: float


@dataclass(frozen=True)
class Spectra:
    """A view from above, turned by each of some quarter turns, in the Fourier domain."""

    view: TopView
    turned: dict[int, tuple[C64, C64, C64]]


def turn(quarters: int) -> F64:
    """(2, 2) what `np.rot90` does to x and y."""
    return np.asarray(np.linalg.matrix_power(np.array([[0.0, 1.0], [-1.0, 0.0]]), quarters))


def spectra(view: TopView, turns: tuple[int, ...], threads: int) -> Spectra:
    """Of the values, of where they are known, and of their squares."""

    def of(a: NDArray[np.float32]) -> C64:
        return np.asarray(fft.rfft2(a, (PADDED, PADDED), workers=threads), np.complex64)

    turned = {}
    for k in turns:
        values, known = np.rot90(view.values, k), np.rot90(view.known, k)
        turned[k] = of(values), of(known), of(values * values)
    return Spectra(view, turned)


def overlay(one: Spectra, other: Spectra, cell: int, threads: int) -> Overlay | None:
    """The best place of the second view on the first; None if they cannot overlap.

    Normalised correlation of all shifts at once, each view only where it is known (Padfield 2012).
    """
    values, known, squares = one.turned[0]

    def back(a: C64) -> NDArray[np.float32]:
        found = fft.irfft2(a, (PADDED, PADDED), workers=threads, overwrite_x=True)
        return np.asarray(found, np.float32)

    fits = {}
    for k, (v, m, s) in other.turned.items():
        overlap = back(known * m.conj())
        energy = back(squares * m.conj()) * np.maximum(back(known * s.conj()), 0)
        like = back(values * v.conj()) / np.sqrt(np.maximum(energy, 1.0))
        enough = overlap > LEAST_OVERLAP * cell**2
        fits[k] = np.where(enough, like * np.sqrt(np.maximum(overlap, 0)), -1.0)
    best = max(fits, key=lambda k: float(fits[k].max()))
    row, column = np.unravel_index(int(fits[best].argmax()), (PADDED, PADDED))
    fit = float(fits[best][row, column])
    if fit <= 0:
        return None
    beside = (np.arange(-BESIDE, BESIDE + 1) + row) % PADDED
    fits[best][np.ix_(beside, (np.arange(-BESIDE, BESIDE + 1) + column) % PADDED)] = -1.0
    second = max(float(f.max()) for f in fits.values())
    moved = np.array([column, row], float)
    moved[moved >= SIDE] -= PADDED
    shift = one.view.origin + moved / cell - turn(best) @ other.view.origin
    return Overlay(best, shift, fit, fit / max(second, 1e-6))
