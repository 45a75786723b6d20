"""What stands still in the picture while the object turns: the background of a turntable.

Camera and room stand still there, so features of the background, and of what round bodies mirror
of the room, lie at the same pixels in photo after photo. They would tell structure from motion
that the camera did not move. On a capture by hand no feature keeps its pixel over several photos.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

SHIFT = 0.0025  # of the photo's long side: a still feature moves less
TURN = 0.2  # radians: a feature on the turntable's axis turns in its place, a still one does not
PARTNERS = 3  # photos in which a feature has to stand still
PARTNER_SHARE = 0.15  # and of the photos that share a still background
MATCHES = 10  # still matches that make two photos share a still background
PHOTO_SHARE = 0.5  # of the photos must have such partners, or the background is taken to move


@dataclass(frozen=True)
class Features:
    """The features of one photo: (n, 2) pixels and (n,) orientation in radians."""

    xy: F32
    turn: F32


@dataclass(frozen=True)
class Still:
    """What stands still.

    Args:
        is_turntable: whether enough photos share a still background.
        features: for each photo (n,) whether the feature stands still.
        share: (photos,) of each photo's matches, those that stand still.
        kept: for each pair (m,) the matches that remain.
    """

    is_turntable: bool
    features: list[Bools]
    share: NDArray[np.float64]
    kept: dict[tuple[int, int], Bools]


def find_still(
    features: list[Features], matches: dict[tuple[int, int], Ints], sides: list[int]
) -> Still:
    """Find features that keep their pixel and orientation in several photos.

    Args:
        matches: for pairs of photos (m, 2) indices of features matched by their look.
        sides: long side of each photo, pixels.
    """
    count = len(features)
    is_still = {
        (a, b): _unmoved(features[a], features[b], found, SHIFT * min(sides[a], sides[b]))
        for (a, b), found in matches.items()
    }
    shares = np.zeros((count, count), bool)
    total, still = np.zeros(count), np.zeros(count)
    for (a, b), flags in is_still.items():
        shares[a, b] = shares[b, a] = flags.sum() >= MATCHES
        for photo in (a, b):
            total[photo] += len(flags)
            still[photo] += flags.sum()
    partners = shares.sum(1)
    seen = [np.zeros(len(one.turn), np.int64) for one in features]
    for (a, b), flags in is_still.items():
        if shares[a, b]:
            seen[a][np.unique(matches[a, b][flags, 0])] += 1
            seen[b][np.unique(matches[a, b][flags, 1])] += 1
    least = [max(PARTNERS, int(np.ceil(PARTNER_SHARE * n))) for n in partners]
    marked = [times >= need for times, need in zip(seen, least, strict=True)]
    kept = {
        (a, b): ~(marked[a][found[:, 0]] | marked[b][found[:, 1]] | is_still[a, b])
        for (a, b), found in matches.items()
    }
    enough = float((partners >= PARTNERS).mean()) if count else 0.0
    return Still(enough >= PHOTO_SHARE, marked, still / np.maximum(total, 1), kept)


def _unmoved(a: Features, b: Features, found: Ints, shift: float) -> Bools:
    """(m,) matches whose two features lie at the same pixel, turned the same way."""
    moved = np.linalg.norm(a.xy[found[:, 0]] - b.xy[found[:, 1]], axis=1)
    turn = a.turn[found[:, 0]] - b.turn[found[:, 1]]
    turned = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
    return np.asarray((moved < shift) & (turned < TURN))
