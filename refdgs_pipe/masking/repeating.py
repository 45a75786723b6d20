"""Grounds whose pattern repeats in two directions: checked cloth, tiles, dotted mats.

Such a pattern is its own mirror image across many lines, so it cannot tell flat mirrors.
"""

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

from refdgs_pipe.ground.shots import F32

ALIKE = 0.5  # correlation with itself, shifted, in two directions
LEAST_SHIFT = 8  # cells: a shorter one is the texture's own grain
SEEN = 0.3  # share of the photos that agree on a cell; and of the overlap of a shift
BROAD = 12.0  # cells: wider shades are left out
PEAK = 9  # cells round a best shift in which none is better
STRIPES = 0.6  # of that correlation: what stays more alike all along one direction is striped
ACROSS = 0.5  # sine of the angle between the two directions


def repeats(picture: F32, share: F32) -> bool:
    """Whether a picture of the ground is like itself at shifts in two directions.

    Args:
        picture: (n, n) log brightness, NaN where nothing is known; share: (n, n) how large a part
            of the photos agrees on it.
    """
    known = (np.isfinite(picture) & (share > SEEN)).astype(np.float64)
    if known.mean() < 0.02:
        return False
    plain = np.where(known > 0, picture, 0)
    mean = gaussian_filter(plain * known, BROAD) / np.maximum(gaussian_filter(known, BROAD), 1e-3)
    alike = _correlated((plain - mean) * known, known)
    tops = (maximum_filter(alike, PEAK) == alike) & (alike > ALIKE)
    y, x = (place - len(picture) for place in np.nonzero(tops))
    far = np.hypot(x, y) >= LEAST_SHIFT
    x, y, value = x[far], y[far], alike[tops][far]
    if not len(value):
        return False
    best = int(value.argmax())
    if _along(alike, 1.5 * float(np.hypot(x[best], y[best]))) > STRIPES * value[best]:
        return False
    length = np.hypot(x, y) * np.hypot(x[best], y[best])
    return bool((np.abs(x[best] * y - y[best] * x) > ACROSS * length).any())


def _along(alike: np.ndarray, reach: float) -> float:
    """The least correlation on the way out, in the direction in which that is greatest."""
    middle = len(alike) // 2
    angle = np.radians(np.arange(0, 180, 1.5))[:, None]
    steps = np.arange(0, min(reach, 0.5 * middle))  # farther, little overlaps
    row = np.rint(middle + steps * np.sin(angle)).astype(int)
    column = np.rint(middle + steps * np.cos(angle)).astype(int)
    return float(alike[row, column].min(1).max())


def _correlated(detail: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(2n, 2n) correlation of a picture (n, n) with itself at all shifts, none in the middle."""
    n = len(detail)
    size = (2 * n, 2 * n)
    picture, weight, square = (np.fft.rfft2(v, size) for v in (detail, known, detail * detail))

    def together(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.asarray(np.fft.irfft2(np.conj(one) * other, size))

    overlap = together(weight, weight)
    energy = together(weight, square) * together(square, weight)
    alike = together(picture, picture) / np.sqrt(np.maximum(energy, 1e-9))
    return np.fft.fftshift(np.where(overlap > SEEN * overlap.max(), alike, 0))
