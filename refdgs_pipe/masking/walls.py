"""Flat vertical mirrors, told by the picture of the plane that they stand on.

A mirror that stands on a textured plane shows the plane as if it went on behind the mirror: photos
from the mirror's side agree on what seems to lie there. It is the mirror image of what lies in
front, across the line on which the mirror stands; and photos from the other side show something
else.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from refdgs_pipe.camera import F64
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32, Bools
from refdgs_pipe.masking.table import Table

TURN_DEG = 1.5  # between the directions of lines that are tried
SECTOR_DEG = 30.0  # between the directions from which pictures of the plane are made
FRONT, OTHER = 0.5, 0.2  # cosine from a mirror's outward direction: photos that see it, and others
FEWEST = 4  # photos of a sector
DEEP, LONG = 0.2, 0.36  # ball radii: the parts that are compared
REACH = 1.1  # ball radii round the middle, in which mirrors are looked for
COARSE = 0.07  # ball radii: wider patterns are left out of what is compared
BLURS = (0.0, 0.017)  # ball radii, of the compared pictures: rough mirrors blur what they show
FAINT = 0.03  # contrast of log brightness that tells nothing
PLAIN = 0.01  # squared, of mixed second differences of log brightness that tell nothing
ALIKE, BETTER = 0.6, 0.4  # least `Wall.likeness` and `Wall.gain` of a mirror
EVEN = 0.4  # median correlation of the parts of a mirror image: it is like in most of them
BLOCKS = 6  # parts along the line; there are two across
# The same of a mirror without another at a right angle or back to back
ALONE, ALONE_BETTER = 0.75, 0.55
AMONG = 0.5  # correlation of a mirror with two others at a right angle or back to back
SQUARE_ALIKE, SQUARE_BETTER = 0.4, 0.3  # the same beside a mirror at a right angle
SQUARE = 0.08  # cosine or sine of the angle between mirrors that counts as right
SHARED = 0.6  # correlation with what other photos see, from which on no mirror is between
USUAL, LEAST_PLAIN = 0.95, 200  # quantile of the likeness of such places; fewest places
ON = 0.35  # correlation at which a mirror goes on, sideways and in depth
MOST_DEEP = 0.8  # ball radii that a mirror image reaches
APART = 0.1  # ball radii between parallel mirrors


@dataclass(frozen=True, eq=False)
class Wall:
    """Where a flat mirror stands, on the plane's axes, world units from the plane's origin.

    Args:
        middle: (2,) a point of its foot; outward: (2,) unit, towards what it mirrors.
        ends: from `middle` along the foot to where it ends.
        deep: how far behind it the mirror image seems to reach.
        likeness: correlation of the mirror image.
        gain: how much that is above the correlation with what other photos see there, and above
            that of places of the plane where no mirror stands.
        even: median correlation of its parts. Two lines of print that cross are their own mirror
            image, and can make up all of the likeness.
    """

    middle: F64
    outward: F64
    ends: tuple[float, float]
    deep: float
    likeness: float
    gain: float
    even: float

    @property
    def along(self) -> F64:
        """(2,) unit, along the foot."""
        return np.array([self.outward[1], -self.outward[0]])


def mirror_walls(table: Table, seen: F32, centers: F64, radius: float) -> list[Wall]:
    """The flat mirrors that stand on the plane.

    What is compared is the mixed second difference along and across the line: an edge that crosses
    the line, or runs along it, is its own mirror image and tells nothing.

    Args:
        seen: (N, n, n, 3) the plane as each photo shows it, log colour, as from `Table.seen`.
        centers: (N, 3) of the cameras, world.
        radius: of the ball round the object, world units.
    """
    ground, n = table.ground, table.cells
    step = 2 * ground.radius / n
    flat = np.stack([(centers - ground.origin) @ axis for axis in (ground.a, ground.b)], -1)
    flat /= np.linalg.norm(flat, axis=1, keepdims=True).clip(1e-12)
    gray = seen.mean(-1)
    size = _Sizes.of(radius / step, n)
    found: list[Wall] = []
    for sector in np.arange(0, 360, SECTOR_DEG):
        towards = flat @ _unit(sector)
        front, other = gray[towards > FRONT], gray[towards < OTHER]
        if len(front) < FEWEST:
            continue
        medians = [_median(part, n) for part in (front, other, front[::2], front[1::2])]
        for blur in BLURS:
            pictures = [_detail(_blurred(m, blur * radius / step), size.coarse) for m in medians]
            for turn in np.arange(sector - SECTOR_DEG / 2, sector + SECTOR_DEG / 2, TURN_DEG):
                found += _lines(pictures, turn, size, step)
    found.sort(key=lambda wall: -wall.gain)
    walls: list[Wall] = []
    for wall in found:
        if not any(_same(wall, other, APART * radius) for other in walls):
            walls.append(wall)
    sure = _sure(walls)
    kept = [w for w in walls if w in sure or any(_square(w, other) for other in sure)]
    return [_met(wall, kept, LONG * radius) for wall in kept]


def _sure(walls: list[Wall]) -> list[Wall]:
    """Mirrors that stand out alone, with one other at a right angle, or less with two others."""
    fair = [w for w in walls if w.likeness >= AMONG and w.gain >= BETTER and w.even >= EVEN]
    clear = [w for w in fair if w.likeness >= ALIKE]
    return [
        wall
        for wall in fair
        if (wall.likeness >= ALONE and wall.gain >= ALONE_BETTER)
        or (wall in clear and any(_square(wall, other) for other in clear))
        or sum(_square(wall, other) for other in fair) >= 2
    ]


def footprint(walls: list[Wall], ground: Ground, n: int) -> Bools:
    """(n, n) cells of the plane's picture that lie behind mirrors, where nobody sees the plane."""
    y, x = ((np.mgrid[0:n, 0:n] + 0.5) / n * 2 - 1) * ground.radius
    behind, before = np.zeros((n, n), bool), np.zeros((n, n), bool)
    for wall in walls:
        out = (x - wall.middle[0]) * wall.outward[0] + (y - wall.middle[1]) * wall.outward[1]
        side = (x - wall.middle[0]) * wall.along[0] + (y - wall.middle[1]) * wall.along[1]
        behind |= (out < 0) & (out > -wall.deep) & (side > wall.ends[0]) & (side < wall.ends[1])
        before |= out > 0
    return behind & ~before


@dataclass(frozen=True)
class _Sizes:
    """In cells: of the compared parts, of the search round the middle, of what is left out."""

    deep: int
    long: int
    first: int
    last: int
    most: int
    coarse: float

    @classmethod
    def of(cls, radius: float, n: int) -> "_Sizes":
        reach = min(round(REACH * radius), n // 2 - 1)
        deep = max(4, round(DEEP * radius))
        long = max(9, round(LONG * radius)) | 1
        most = max(deep, round(MOST_DEEP * radius))
        return cls(deep, long, n // 2 - reach, n // 2 + reach, most, COARSE * radius)


def _unit(degrees: float) -> F64:
    angle = np.radians(degrees)
    return np.array([np.cos(angle), np.sin(angle)])


def _median(part: F32, n: int) -> F32:
    """(n, n) of photos, NaN where none shows the plane."""
    if not len(part):
        return np.full((n, n), np.nan, np.float32)
    return np.asarray(torch.from_numpy(part).nanmedian(0).values.numpy(), np.float32)


def _blurred(picture: F32, sigma: float) -> F32:
    """(n, n) blurred by `sigma` cells where anything is known; NaN stays NaN."""
    if sigma == 0:
        return picture
    known = np.isfinite(picture).astype(np.float32)
    total = cv2.GaussianBlur(np.nan_to_num(picture), (0, 0), sigma)
    mean = total / np.maximum(cv2.GaussianBlur(known, (0, 0), sigma), 1e-3)
    return np.where(known > 0, mean, np.nan).astype(np.float32)


def _detail(picture: F32, coarse: float) -> F32:
    """(n, n) without what varies slowly; 0 where nothing is known."""
    known = np.nan_to_num(picture)
    fine = known - cv2.GaussianBlur(known, (0, 0), coarse)
    fine = np.where(np.isfinite(picture), fine, 0).clip(-0.5, 0.5).astype(np.float32)
    contrast = np.sqrt(cv2.GaussianBlur(fine * fine, (0, 0), coarse) + FAINT**2)
    return np.asarray(fine / contrast, np.float32)


def _lines(pictures: list[F32], turn: float, size: _Sizes, step: float) -> list[Wall]:
    """What may be mirrors that face one direction.

    Args:
        pictures: (n, n) of the photos in front of the mirrors, of the others, and of the first
            and the second half of those in front.
        turn: degrees of the outward direction from the picture's x axis.
    """
    n = len(pictures[0])
    middle = (n - 1) / 2
    turned = cv2.getRotationMatrix2D((middle, middle), turn - 90, 1)  # outward: more rows
    mixed = [
        cv2.Sobel(cv2.warpAffine(p, turned, (n, n)), cv2.CV_32F, 1, 1, ksize=5) / 16
        for p in pictures
    ]
    front, other, *halves = (m[:, size.first : size.last] for m in mixed)
    back = np.linalg.inv(np.vstack([turned, [0, 0, 1]]))
    found = []
    rows = range(max(size.first, size.deep), min(size.last, n - size.deep + 1))
    images, shared = np.zeros((2, len(rows), front.shape[1]), np.float32)
    for k, row in enumerate(rows):
        outside = front[row : row + size.deep]
        inside, seen, *parts = (m[row - size.deep : row][::-1] for m in (front, other, *halves))
        images[k] = np.minimum(*(_alike(part, -outside, size.long) for part in parts))
        shared[k] = _alike(inside, seen, size.long)
    usual = _usual(images, shared)
    for row, image, also in zip(rows, images, shared, strict=True):
        gain = image - np.maximum(also, usual)
        best = int(gain.argmax())
        if image[best] < SQUARE_ALIKE or gain[best] < SQUARE_BETTER:
            continue
        left, right, deep = _extent(front, row, best, size)
        column = size.first + (left + right - 1) / 2
        place = (back @ [column, row - 0.5, 1])[:2]
        if np.linalg.norm(place - middle) > (size.last - size.first) / 2:
            continue
        world = (place + 0.5 - n / 2) * step
        outward = _unit(turn)
        half = (right - left) / 2 * step
        near, outside = front[row - size.deep : row][::-1], front[row : row + size.deep]
        even = _evenly(near[:, left:right], -outside[:, left:right])
        figures = (float(image[best]), float(gain[best]), even)
        found.append(Wall(world, outward, (-half, half), deep * step, *figures))
    return found


def _usual(images: F32, shared: F32) -> float:
    """How like their mirror images places of the plane are where no mirror stands.

    Tiles and checks are their own mirror images, and look like a mirror wherever one photo alone
    shows them.

    Args:
        images: (R, W) correlation of mirror images; shared: (R, W) of what other photos see there.
    """
    plain = images[shared >= SHARED]
    return max(0.0, float(np.quantile(plain, USUAL))) if len(plain) >= LEAST_PLAIN else 0.0


def _alike(one: F32, other: F32, long: int) -> F32:
    """(W,) correlation of two (D, W), over windows along the rows."""
    sums = [(one * other).mean(0), (one * one).mean(0), (other * other).mean(0)]
    both, first, second = (cv2.blur(s[None].astype(np.float32), (long, 1))[0] for s in sums)
    return np.asarray(both / np.sqrt((first + PLAIN) * (second + PLAIN)), np.float32)


def _evenly(one: F32, other: F32) -> float:
    """Median correlation of the blocks of two (D, W)."""
    found = []
    for rows in np.array_split(np.arange(one.shape[0]), 2):
        for columns in np.array_split(np.arange(one.shape[1]), BLOCKS):
            a, b = (part[np.ix_(rows, columns)] for part in (one, other))
            scale = np.sqrt(((a * a).mean() + PLAIN) * ((b * b).mean() + PLAIN))
            found.append(float((a * b).mean() / scale))
    return float(np.median(found))


def _extent(front: F32, row: int, best: int, size: _Sizes) -> tuple[int, int, int]:
    """First column, column after the last, and rows of depth that a mirror image has."""
    outside, inside = front[row : row + size.deep], front[row - size.deep : row][::-1]
    goes_on = _alike(inside, -outside, size.long // 2 | 1) > ON
    left = right = best
    while left > 0 and goes_on[left - 1]:
        left -= 1
    while right < len(goes_on) and goes_on[right]:
        right += 1
    left, right = min(left, best - size.long // 2), max(right, best + size.long // 2 + 1)
    left, right = max(left, 0), min(right, len(goes_on))
    deep, band = size.deep, max(3, size.deep // 2)
    while deep + band <= min(size.most, row, len(front) - row):
        far = front[row + deep : row + deep + band, left:right]
        near = front[row - deep - band : row - deep, left:right][::-1]
        if _alike(near, -far, right - left)[(right - left) // 2] < ON:
            break
        deep += band
    return left, right, deep


def _met(wall: Wall, others: list[Wall], far: float) -> Wall:
    """The mirror with ends where it meets others at a corner that is not far from its ends."""
    low, high = wall.ends
    for other in others:
        turn = float(wall.along @ other.outward)
        if abs(turn) < 0.3:
            continue
        side = float((other.middle - wall.middle) @ other.outward) / turn
        corner = wall.middle + side * wall.along
        place = float((corner - other.middle) @ other.along)
        if not other.ends[0] - far < place < other.ends[1] + far:
            continue
        if turn > 0 and abs(side - wall.ends[1]) < far:  # before the other from here on
            high = side
        if turn < 0 and abs(side - wall.ends[0]) < far:
            low = side
    return replace(wall, ends=(low, high))


def _square(one: Wall, other: Wall) -> bool:
    """Whether two face opposite directions, or stand at a right angle."""
    cosine = float(one.outward @ other.outward)
    return abs(cosine) < SQUARE or cosine < -(1 - SQUARE**2 / 2)


def _same(one: Wall, other: Wall, apart: float) -> bool:
    """Whether two that face the same way are one mirror, or one lies in the other's image."""
    between = one.middle - other.middle
    out = float(between @ other.outward)
    beside = abs(float(between @ other.along)) < one.ends[1] + other.ends[1]
    return bool(one.outward @ other.outward > 0.9 and beside and -other.deep - apart < out < apart)
