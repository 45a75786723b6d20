"""Places below an object where no texture proves that photos see the plane.

Where an object stands, no photo sees the plane. Photos can still agree on a colour there: that of
a blurred reflection on the foot of the object. But photos from different sides do not agree on a
texture there, as they do where they see the plane.

The places below an object are found by what it hides. A point above the plane is taken if many
photos do not see the plane behind it.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32, Bools
from refdgs_pipe.masking.table import TOLERANCES, same_texture

HEIGHTS = (0.1, 0.15, 0.2, 0.3, 0.4)  # ball radii above the plane
TAKEN = 0.4  # share of the photos that do not see the plane behind a place of the object
SEEN = 0.6  # share of the photos that have to show a place
SMOOTH = 0.035  # ball radii over which that share is averaged
PATCHES = (2.0, 3.0)  # cells (sigma) over which texture is compared
AGREE, TEXTURED = 0.5, 0.5  # correlation, and degree of texture, of a proof
SECTORS, APART = 12, 2  # directions; that many apart have to agree
GAP, FOOT = 0.08, 0.2  # ball radii: narrower gaps are closed, narrower feet are left out
ALIKE = 0.5  # mean share of the photos that have to agree on the colour of a part
ONCE = 0.05  # share of the cells inside a part, at most, whose texture any photo shows
# The same of a glossy ground, whose colours photos agree on less: what they show is its own gloss
ALIKE_GLOSSY, ONCE_GLOSSY = 0.25, 0.5
LEAK = 3  # cells by which the texture of its own edge proves a foot's inside
AROUND, PROVEN = 0.25, 0.4  # ball radii round the places, and the share of it that is proven
GROUND = 0.9  # share of a part's cells with proven texture, above which the part is ground


def unproven(
    colour: F32,
    seen: F32,
    ground: Ground,
    centers: F64,
    radius: float,
    towards: Bools,
    *,
    glossy: bool = False,
) -> Bools:
    """(n, n) cells of the plane below something, where nothing proves that photos see the plane.

    No cell is marked if the plane around them is not proven either. A part is marked only if most
    photos agree on its colour: that agreement is the evidence for the plane that can mislead. And
    no photo may show the plane's texture in more than a few of its cells: then it is ground that
    the object hides from most photos.

    Args:
        colour: (n, n, 3) log colour that most photos agree on, NaN where unknown.
        seen: (N, n, n, 3) the plane as each photo shows it, as from `Table.seen`.
        centers: (N, 3) of the cameras, world; radius: of the ball round the object, world units.
        towards: (SECTORS, n, n) of `shown_from`.
        glossy: whether the plane is.
    """
    n = len(colour)
    cell = 2 * ground.radius / n
    sure = proven(towards)
    under = below(colour, seen, ground, centers, radius) & ~sure
    gap, foot = (_disc(width * radius / cell) for width in (GAP, FOOT))
    closed = cv2.morphologyEx(under.astype(np.uint8), cv2.MORPH_CLOSE, gap)
    found = cv2.morphologyEx(closed, cv2.MORPH_OPEN, foot) > 0
    wide = max(1, round(AROUND * radius / cell))
    around = cv2.dilate(found.astype(np.uint8), np.ones((2 * wide + 1,) * 2, np.uint8)) > found
    if not found.any() or sure[around].mean() < PROVEN:
        return np.zeros((n, n), bool)
    limits = (ALIKE_GLOSSY, ONCE_GLOSSY) if glossy else (ALIKE, ONCE)
    parts = _misleading(found, colour, seen, np.asarray(towards.any(0)), *limits)
    return np.asarray(cv2.dilate(parts.astype(np.uint8), _disc(2 * LEAK + 1)) > 0)


def proven(towards: Bools) -> Bools:
    """(n, n) cells whose texture photos from directions that lie far apart agree on.

    Args:
        towards: (SECTORS, n, n) of `shown_from`.
    """
    found = np.zeros(towards.shape[1:], bool)
    for i in range(SECTORS):
        for j in range(i + APART, min(SECTORS, i + SECTORS - APART + 1)):
            found |= towards[i] & towards[j]
    return found


def without_ground(bodies: Bools, sure: Bools) -> Bools:
    """(n, n) the bodies, without the parts that have the plane's texture all over.

    A light tile in the shade of a body has one colour, and the body hides what lies round it, as if
    the tile were a plain foot. But photos from several sides agree on the joints between tiles.

    Args:
        sure: (n, n) of `proven`.
    """
    count, parts = cv2.connectedComponents(bodies.astype(np.uint8))
    ground = _means(sure, parts, count) > GROUND
    return np.asarray(bodies & ~ground[parts])


def shown_from(colour: F32, seen: F32, ground: Ground, centers: F64) -> Bools:
    """(SECTORS, n, n) cells whose texture a photo from each direction shows.

    Args:
        colour, seen, ground, centers: as for `unproven`.
    """
    flat = _beside(ground, centers)
    azimuth = np.arctan2(flat[:, 1], flat[:, 0]) % (2 * np.pi)
    sector = np.minimum((azimuth / (2 * np.pi) * SECTORS).astype(int), SECTORS - 1)
    picture = np.nan_to_num(colour).mean(-1)
    agreed = np.zeros((SECTORS, *picture.shape), bool)
    for one, towards in zip(seen, sector, strict=True):
        near = np.abs(one - colour).max(-1) < TOLERANCES[0]  # not where either is unknown
        known = np.isfinite(one[..., 0]) & np.isfinite(colour[..., 0])
        shown = np.where(known, one.mean(-1), picture).astype(np.float32)
        whole = cv2.erode(known.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        for sigma in PATCHES:
            like, texture = same_texture(shown, picture, sigma)
            agreed[towards] |= whole & near & (like > AGREE) & (texture > TEXTURED)
    return agreed


def below(colour: F32, seen: F32, ground: Ground, centers: F64, radius: float) -> Bools:
    """(n, n) cells above which, at some height, many photos do not see the plane.

    Args:
        colour, seen, ground, centers, radius: as for `unproven`.
    """
    n = len(colour)
    cell = 2 * ground.radius / n
    flat = _beside(ground, centers)
    high = np.abs((centers - ground.origin) @ np.cross(ground.a, ground.b))
    known = np.isfinite(seen[..., 0]) & np.isfinite(colour[..., 0])
    other = (np.abs(seen - colour).max(-1) > TOLERANCES[0]) & known
    found = np.zeros((n, n), bool)
    for height in np.array(HEIGHTS) * radius:
        taken, count = np.zeros((2, n, n), np.float32)
        for i in np.flatnonzero(high > 1.5 * height):
            # A point at this height hides the plane where the camera's ray through it meets it.
            grow = high[i] / (high[i] - height)
            offset = (1 - grow) * (flat[i] / cell + n / 2 - 0.5)
            away = np.array([[grow, 0, offset[0]], [0, grow, offset[1]]])
            how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            taken += cv2.warpAffine(other[i].astype(np.float32), away, (n, n), flags=how)
            count += cv2.warpAffine(known[i].astype(np.float32), away, (n, n), flags=how)
        share = np.where(count >= SEEN * len(seen), taken / np.maximum(count, 1), 0)
        found |= cv2.GaussianBlur(share, (0, 0), SMOOTH * radius / cell) > TAKEN
    return found


def _misleading(
    found: Bools,
    colour: F32,
    seen: F32,
    once: Bools,
    least: float = ALIKE,
    most: float = ONCE,
) -> Bools:
    """(n, n) the parts of what was found on whose colour most photos agree, without texture.

    Args:
        once: (n, n) cells whose texture at least one photo shows. Near the edge of a part they do
            not count: the texture there may be that of the plane beside it.
        least, most: as `ALIKE` and `ONCE`.
    """
    known = np.isfinite(seen[..., 0]) & np.isfinite(colour[..., 0])
    near = (np.abs(seen - colour).max(-1) < TOLERANCES[1]) & known
    share = near.sum(0) / np.maximum(known.sum(0), 1)
    count, parts = cv2.connectedComponents(found.astype(np.uint8))
    alike = _means(share, parts, count)
    inside = np.where(cv2.erode(found.astype(np.uint8), _disc(2 * LEAK + 1)) > 0, parts, 0)
    shown = _means(once, inside, count)
    wanted = (alike >= least) & (shown <= most)
    wanted[0] = False
    return np.asarray(wanted[parts])


def _means(values: NDArray[Any], parts: NDArray[Any], count: int) -> F64:
    """(count,) the mean of `values` (n, n) over each of the numbered `parts` (n, n); 0 if empty."""
    cells = np.maximum(np.bincount(parts.ravel(), minlength=count), 1)
    return np.asarray(np.bincount(parts.ravel(), values.ravel(), count) / cells)


def _disc(width: float) -> NDArray[np.uint8]:
    """A kernel of so many cells across, an odd number of at least three."""
    size = max(3, round(width)) | 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def _beside(ground: Ground, centers: F64) -> F64:
    """(N, 2) the cameras on the plane's axes."""
    return np.stack([(centers - ground.origin) @ axis for axis in (ground.a, ground.b)], -1)
