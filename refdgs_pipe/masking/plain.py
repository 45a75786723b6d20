"""Plain bodies that stand on the plane: told from plain paper by what they hide.

Photos from all sides agree on the one colour of a plain plinth, as if it lay flat on the plane. But
a body hides what lies behind it. So just outside of the region of that colour, photos that look
across the region see the body, and only photos from the near side see the plane. Photos from the
near side also see the plane below a body that hangs over it, and the body's foot if it stands. So
where a body hangs, what most photos agree on is the body and no picture of the plane.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32, Bools

SEEDS = 8  # cells between places that a region is grown from
PLAIN = 0.35  # of log colour, within a region
NARROW = 0.2  # the same, for a region that otherwise runs into the table
WITHIN = 1.3  # ball radii from the middle: farther out it is the table
LEAST_AREA = 0.02  # square ball radii
CLOSED = 7  # cells: gaps in a region that are closed
EDGE = 2, 6  # cells beside a region's border that are looked at, on either side
SET_OFF = 0.65  # share of the places right outside that differ from a narrow region, at least
DIFFERS = 0.25  # of log colour, between what a photo shows and what the photos agree on
# Least step of log colour across a region's border, and share of the border that has it. A shadow
# fades, a body ends. The same for narrow regions, whose steps are smaller
STEP, STEPS = 0.5, 0.5
NARROW_STEP, NARROW_STEPS = DIFFERS, 0.7
LIKE = 0.5  # of log colour, from the region's, of what may be the same body
ACROSS = 0.5  # cosine between a border's outward direction and that to a camera
SECTORS = 8  # of outward directions
# Share of the photos across that see something else: median of the sectors, and all but one
HIDDEN, HIDDEN_LEAST = 0.55, 0.4
SHOWN = 0.2  # the same share of the photos before the border, at most
# How much as often as inside a photo across sees the region's colour outside, at least. A low foot
# hides no more than a narrow strip, so this may also hold for what hides the outside
GOES_ON = 0.6
OFTEN = 0.2  # how often it sees it inside, at least
# How often a photo before the border sees the region's colour inside, at least: median
FOOT = 0.6
SURE = 0.8  # the same of a narrow region


def plain_bodies(
    colour: F32, seen: F32, ground: Ground, centers: F64, radius: float
) -> tuple[Bools, Bools]:
    """(n, n) where a plain body stands, and (n, n) where one only hangs over the plane.

    Args:
        colour: (n, n, 3) log colour of the plane, on which photos agree; NaN where unknown.
        seen: (N, n, n, 3) the plane as each photo shows it; NaN where it does not.
        ground: of these pictures; centers: (N, 3) of the cameras, world.
        radius: of the ball, world units.
    """
    n = len(colour)
    off = centers - ground.origin
    cameras = np.stack([off @ ground.a, off @ ground.b], 1)
    place = ((np.arange(n) + 0.5) / n * 2 - 1) * ground.radius
    x, y = np.meshgrid(place, place)
    far = np.hypot(x, y) / radius
    even = cv2.medianBlur(np.nan_to_num(colour, nan=-9.0).astype(np.float32), 5)
    least = LEAST_AREA * radius**2 / (2 * ground.radius / n) ** 2
    stands, hangs = np.zeros((2, n, n), bool)
    known = np.isfinite(colour[..., 0])
    closed, at = np.ones((CLOSED, CLOSED), np.uint8), np.stack([x, y], -1)
    for region, narrow in _regions(even, known, far, least):
        whole = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_CLOSE, closed) > 0
        hides, foot = _hides(whole, colour, seen, cameras, at, narrow=narrow)
        if hides:
            (stands if foot else hangs)[whole] = True
    return stands, hangs & ~stands


def _regions(colour: F32, known: Bools, far: F64, least: float) -> Iterator[tuple[Bools, bool]]:
    """Regions (n, n) of one colour that end on the table, and whether they are narrow.

    Args:
        colour: (n, n, 3) log colour; known: (n, n) where photos agree on one.
        far: (n, n) from the middle, ball radii; least: cells of a region.
    """
    starts = known & (far <= 1)
    for narrow, limit in ((False, PLAIN), (True, NARROW)):
        runs_on = np.zeros_like(known)
        for row in range(SEEDS // 2, len(colour), SEEDS):
            for column in range(SEEDS // 2, len(colour), SEEDS):
                if not starts[row, column]:
                    continue
                alike = np.abs(colour - colour[row, column]).max(-1) < limit
                labels = cv2.connectedComponents(alike.astype(np.uint8), connectivity=4)[1]
                region = np.asarray(labels == labels[row, column])
                starts &= ~region
                if far[region].max() > WITHIN:
                    runs_on |= region
                elif region.sum() >= least:
                    yield region, narrow
        starts = known & (far <= 1) & runs_on


@dataclass(frozen=True, eq=False)
class _Border:
    """Cells on one side of a region's border.

    Args:
        cells: (n, n) which; at: (K, 2) where, on the plane's axes; outward: (K, 2) unit.
    """

    cells: Bools
    at: F64
    outward: F64

    @classmethod
    def of(cls, outside: Bools, place: F64, sign: float) -> "_Border":
        """The cells at EDGE from the border, of the side where `outside` is true."""
        distance = cv2.distanceTransform(outside.astype(np.uint8), cv2.DIST_L2, 5)
        cells = (distance > EDGE[0]) & (distance <= EDGE[1])
        down, right = np.gradient(cv2.GaussianBlur(distance, (0, 0), 2))
        outward = sign * np.stack([right, down], -1)[cells].astype(np.float64)
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
        return cls(cells, place[cells], outward)

    @property
    def sector(self) -> NDArray[np.int64]:
        """(K,) which of SECTORS the outward direction belongs to."""
        turn = np.arctan2(self.outward[:, 1], self.outward[:, 0]) / (2 * np.pi)
        return np.floor(turn * SECTORS).astype(np.int64) % SECTORS

    def facing(self, camera: F64) -> F64:
        """(K,) cosine between the outward direction and that to a camera (2,)."""
        to = camera - self.at
        return np.asarray((self.outward * to).sum(1) / np.linalg.norm(to, axis=1))


class _Share:
    """How often something was so, for each sector of a border."""

    def __init__(self) -> None:
        self._so, self._all = np.zeros(SECTORS), np.zeros(SECTORS)

    def add(self, sector: NDArray[np.int64], so: Bools) -> None:
        self._so += np.bincount(sector[so], minlength=SECTORS)
        self._all += np.bincount(sector, minlength=SECTORS)

    @property
    def by_sector(self) -> F64:
        return np.asarray(self._so / np.maximum(self._all, 1))

    @property
    def whole(self) -> float:
        return float(self._so.sum() / max(self._all.sum(), 1.0))


class _Shares:
    """The same of photos that look across the region, and of those from before the border."""

    def __init__(self) -> None:
        self.across, self.before = _Share(), _Share()

    def add(self, border: _Border, camera: F64, told: Bools, so: Bools) -> None:
        """Count what a photo shows; told, so: (K,) for the border's cells."""
        facing, sector = border.facing(camera), border.sector
        for share, at in (
            (self.across, told & (facing < -ACROSS)),
            (self.before, told & (facing > ACROSS)),
        ):
            share.add(sector[at], so[at])


def _steps(colour: F32, outer: _Border, inner: _Border) -> F32:
    """(K,) by how much log colour outside of a border differs from that inside, close by.

    Args:
        colour: (n, n, 3) log colour; NaN where unknown.
    """
    size = (2 * EDGE[1] + 5,) * 2
    use = (inner.cells & np.isfinite(colour[..., 0])).astype(np.float32)
    total = cv2.blur(np.where(use[..., None] > 0, colour, 0).astype(np.float32), size)
    share = cv2.blur(use, size)
    near = total / np.maximum(share, 1e-6)[..., None]
    apart = np.abs(colour - near).max(-1)[outer.cells & (share > 0.5 / size[0] ** 2)]
    return np.asarray(apart[np.isfinite(apart)], np.float32)


def _hides(
    region: Bools, colour: F32, seen: F32, cameras: F64, place: F64, *, narrow: bool
) -> tuple[bool, bool]:
    """Whether a region of one colour is that of a body, and whether it is the body's foot.

    Args:
        cameras: (N, 2) and place: (n, n, 2), on the plane's axes.
        narrow: whether the table has much the same colour: then more is asked for, and a body that
            hangs is not told.
    """
    own = np.nanmedian(colour[region], axis=0)
    outer, inner = _Border.of(~region, place, 1.0), _Border.of(region, place, -1.0)
    agreed = colour[outer.cells]
    other = np.abs(agreed - own).max(-1) > DIFFERS
    if narrow and np.count_nonzero(other) < SET_OFF * other.size:
        return False, False
    step, least = (NARROW_STEP, NARROW_STEPS) if narrow else (STEP, STEPS)
    steps = _steps(colour, outer, inner)
    if not len(steps) or np.mean(steps > step) < least:
        return False, False
    hidden, as_outside, as_inside, where_hidden = (_Shares() for _ in range(4))
    for camera, photo in zip(cameras, seen, strict=True):
        shown = photo[outer.cells]
        told = np.isfinite(shown[:, 0]) & other
        differs = np.abs(shown - agreed).max(-1) > DIFFERS
        alike = np.abs(shown - own).max(-1) < LIKE
        hidden.add(outer, camera, told, differs)
        as_outside.add(outer, camera, told, alike)
        where_hidden.add(outer, camera, told & differs, alike)
        shown = photo[inner.cells]
        told = np.isfinite(shown[:, 0])
        as_inside.add(inner, camera, told, np.abs(shown - own).max(-1) < LIKE)
    hides = np.sort(hidden.across.by_sector)
    often = as_inside.across.whole
    body = (
        np.median(hides) > HIDDEN
        and hides[1] > HIDDEN_LEAST
        and np.median(hidden.before.by_sector) < SHOWN
        and often > OFTEN
        and max(as_outside.across.whole, where_hidden.across.whole) > GOES_ON * often
    )
    foot = bool(np.median(as_inside.before.by_sector) > (SURE if narrow else FOOT))
    return bool(body) and (foot or not narrow), foot
