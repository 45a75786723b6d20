"""Grounds whose pattern repeats in two directions: checked cloth, tiles, dotted mats.

Such a pattern is its own mirror image across many lines, so it cannot tell flat mirrors. But it
tells what the ground looks like where an object hides it, and so where the object stands.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.ndimage import binary_fill_holes, gaussian_filter, label, maximum_filter

from refdgs_pipe.camera import F64
from refdgs_pipe.ground.shots import F32, Bools

ALIKE = 0.5  # correlation with itself, shifted, in two directions
LEAST_SHIFT = 8  # cells: a shorter one is the texture's own grain
SEEN = 0.3  # share of the photos that agree on a cell; and of the overlap of a shift
BROAD = 12.0  # cells: wider shades are left out
PEAK = 9  # cells round a best shift in which none is better
STRIPES = 0.6  # of that correlation: what stays more alike all along one direction is striped
ACROSS = 0.5  # sine of the angle between the two directions
AS_GOOD = 0.85  # of the best correlation: the shortest of these shifts is the pattern's own
MULTIPLES = (1, 2, 3, 4, 6, 8)  # of a shift, on which it is measured the more finely
NEAR = 3  # cells round such a multiple, in which its peak is looked for
FARTHEST = 0.45  # of the picture's edge
COPIES = 60  # places of the pattern, at most, that tell what a place looks like
STEPS = 6  # of the pattern, as far as copies are taken
OWN = 0.5  # share of all photos that agree on a place, from which on it is the ground's own
CERTAIN = 0.6  # the same, from which on nothing stands there
DIFFERS = 0.12  # of log colour, at least, between a place and the pattern
USUAL = 0.98  # quantile of that difference where nothing stands
ABOVE = 1.5  # times that
SHADE = 0.33  # of the period: what is smoother is a shadow
CLOSED, OPENED = 0.33, 0.15  # of the period: gaps that are closed, slivers that go
DOUBTFUL = 0.35  # of the period, along the edge of what differs: shade under what hangs over, blur
LEAST_AREA = 1.0  # of the area of one repeat
WITHIN = 0.95  # of what differs, that the ground surrounds: beyond its edge everything differs


@dataclass(frozen=True, eq=False)
class Lattice:
    """Two shifts (2,), x and y in cells of the picture, at which a ground's pattern repeats."""

    one: F64
    other: F64

    @property
    def period(self) -> float:
        """Length of the shorter shift, cells."""
        return float(min(np.hypot(*self.one), np.hypot(*self.other)))

    def shifts(self) -> list[F64]:
        """Shifts of the pattern onto itself, the shortest first."""
        steps = range(-STEPS, STEPS + 1)
        all_of = [i * self.one + j * self.other for i in steps for j in steps if i or j]
        return sorted(all_of, key=lambda shift: float(np.hypot(*shift)))[:COPIES]


def lattice(picture: F32, share: F32) -> Lattice | None:
    """The shifts in two directions at which a picture of the ground is like itself, if it is.

    Args:
        picture: (n, n) log brightness, NaN where nothing is known; share: (n, n) how large a part
            of the photos agrees on it.
    """
    known = (np.isfinite(picture) & (share > SEEN)).astype(np.float64)
    if known.mean() < 0.02:
        return None
    plain = np.where(known > 0, picture, 0)
    mean = gaussian_filter(plain * known, BROAD) / np.maximum(gaussian_filter(known, BROAD), 1e-3)
    alike = _correlated((plain - mean) * known, known)
    tops = (maximum_filter(alike, PEAK) == alike) & (alike > ALIKE)
    y, x = (place - len(picture) for place in np.nonzero(tops))
    length = np.hypot(x, y)
    far = length >= LEAST_SHIFT
    x, y, length, value = x[far], y[far], length[far], alike[tops][far]
    if not len(value):
        return None
    best = int(value.argmax())
    if _along(alike, 1.5 * float(length[best])) > STRIPES * value[best]:
        return None
    one = _shortest(value, length)
    across = np.abs(x[one] * y - y[one] * x) > ACROSS * length[one] * length
    if not across.any():
        return None
    other = np.flatnonzero(across)[_shortest(value[across], length[across])]
    first, second = (_measured(alike, np.array([x[k], y[k]], float)) for k in (one, other))
    return Lattice(first, second)


def covered(colour: F32, agreeing: F32, pattern: Lattice) -> Bools:
    """(n, n) where something stands: what photos show there does not go on with the pattern.

    Shadows are smooth over a repeat, so slow changes of brightness are left out of the difference.
    A mirror shows the pattern too, but not in its place.

    Args:
        colour: (n, n, 3) log colour that most photos agree on, NaN where nothing is known.
        agreeing: (n, n) share of all photos that agree.
    """
    own = np.isfinite(colour[..., 0]) & (agreeing > OWN)
    expected = continued(colour, own, pattern)
    extent = binary_fill_holes(_morphed(own, cv2.MORPH_CLOSE, CLOSED * pattern.period))
    both = np.isfinite(expected[..., 0]) & np.isfinite(colour[..., 0]) & extent
    empty = both & (agreeing > CERTAIN)
    if not empty.any():
        return np.zeros(both.shape, bool)
    apart = np.where(both[..., None], colour - expected, 0)
    ground = both
    for _ in range(2):  # the shade of the ground alone, once it is roughly known
        shade = _spread(apart.mean(-1), ground, SHADE * pattern.period)
        off = np.where(both, np.abs(apart - shade[..., None]).max(-1), 0)
        broad = _spread(off, both, pattern.period / 6)
        limit = max(DIFFERS, ABOVE * float(np.quantile(broad[empty], USUAL)))
        ground = both & (empty | (broad <= limit))
    differs = both & ~ground & (off > limit)
    around = binary_fill_holes(_morphed(own & ~differs, cv2.MORPH_CLOSE, CLOSED * pattern.period))
    found = _pieces(_morphed(differs, cv2.MORPH_CLOSE, CLOSED * pattern.period), around, 0)
    area = abs(pattern.one[0] * pattern.other[1] - pattern.one[1] * pattern.other[0])
    whole = _morphed(binary_fill_holes(found), cv2.MORPH_OPEN, OPENED * pattern.period)
    stands = _pieces(whole, around, LEAST_AREA * area)
    return _morphed(stands, cv2.MORPH_ERODE, DOUBTFUL * pattern.period)


def _pieces(part: Bools, around: Bools, least: float) -> Bools:
    """The pieces of a part that the ground surrounds and that have an area, in cells, at least.

    Only those may be filled: what lies beyond the ground's edge goes all round it.
    """
    pieces, count = label(part)
    sizes = np.bincount(pieces.ravel(), minlength=count + 1)
    within = np.bincount(pieces[around], minlength=count + 1)
    wanted = (sizes >= least) & (within >= WITHIN * sizes)
    wanted[0] = False
    return np.asarray(wanted[pieces])


def continued(colour: F32, own: Bools, pattern: Lattice) -> F32:
    """(n, n, 3) what the pattern's other places say of each place; NaN where they say nothing.

    Args:
        colour: (n, n, 3); own: (n, n) where it is the ground's own.
    """
    n = len(colour)
    ground = np.where(own[..., None], colour, np.float32(np.nan)).astype(np.float32)
    copies = np.empty((COPIES, n, n, 3), np.float32)
    for copy, (x, y) in zip(copies, pattern.shifts(), strict=True):
        move = np.array([[1, 0, x], [0, 1, y]], np.float32)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        copy[:] = cv2.warpAffine(ground, move, (n, n), flags=flags, borderValue=(np.nan,) * 3)
    return np.asarray(torch.from_numpy(copies).nanmedian(0).values.numpy())


def _morphed(part: Bools, how: int, radius: float) -> Bools:
    size = 2 * max(1, round(radius)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.morphologyEx(part.astype(np.uint8), how, disc) > 0)


def _spread(value: np.ndarray, known: Bools, sigma: float) -> np.ndarray:
    """(n, n) blurred over what is known."""
    weight = gaussian_filter(known.astype(np.float64), sigma)
    return np.asarray(gaussian_filter(np.where(known, value, 0), sigma) / np.maximum(weight, 1e-3))


def _shortest(value: np.ndarray, length: np.ndarray) -> int:
    """The shortest shift that is nearly as good as the best one."""
    good = np.flatnonzero(value > AS_GOOD * value.max())
    return int(good[length[good].argmin()])


def _measured(alike: np.ndarray, shift: F64) -> F64:
    """A shift, to a fraction of a cell, by the peaks at its multiples."""
    middle = len(alike) // 2
    for times in MULTIPLES:
        x, y = np.rint(shift * times).astype(int)
        if max(abs(x), abs(y)) > FARTHEST * middle:
            break
        part = alike[
            middle + y - NEAR : middle + y + NEAR + 1, middle + x - NEAR : middle + x + NEAR + 1
        ]
        row, column = np.unravel_index(int(part.argmax()), part.shape)
        if part.max() < ALIKE or {0, 2 * NEAR} & {int(row), int(column)}:
            break
        down, right = _peak(part[:, column], int(row)), _peak(part[row], int(column))
        shift = np.array([x + right - NEAR, y + down - NEAR]) / times
    return shift


def _peak(values: np.ndarray, at: int) -> float:
    """Where a parabola through three values has its top."""
    before, here, after = values[at - 1 : at + 2]
    bend = before - 2 * here + after
    return at + 0.5 * float(before - after) / float(bend) if bend < 0 else float(at)


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
