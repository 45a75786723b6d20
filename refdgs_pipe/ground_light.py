"""The light that the ground sends: what photos show beside the object, where it lies.

Light from far away cannot tell what a wall mirrors of the board that it stands on: each place of
the wall shows another place of the board. But photos show the board itself. So this light is known,
and with it how much a surface reflects.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.light import ROUGHNESSES, SMOOTHEST, level_weights

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_BLURS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # cells, sigma
_WIDTH = 1.7  # times roughness squared: sigma, in radians, of what half of a GGX lobe lies in
_GRAZING = 0.02  # sine of the angle to the ground below which nothing is said


@dataclass(frozen=True, eq=False)
class GroundLight:
    """A picture of the ground, seen from above.

    Args:
        picture: (n, n, 4) linear radiance times the share that is known, and that share; rows
            along `b`, columns along `a`.
        origin: (3,) its middle, world; a, b: (3,) its unit axes.
        radius: half its edge, world units.
    """

    picture: F32
    origin: F64
    a: F64
    b: F64
    radius: float

    @cached_property
    def _blurred(self) -> F32:
        """(levels * n * n, 4) the picture at each of _BLURS."""
        import cv2

        levels = [np.asarray(self.picture, np.float32)]
        for sigma in _BLURS[1:]:
            levels.append(
                cv2.GaussianBlur(levels[0], (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
            )
        return np.concatenate([level.reshape(-1, 4) for level in levels])

    def mirrored(self, points: F32, directions: F32, roughness: F32) -> F32:
        """(N, 4) what rays meet of the ground: linear radiance times its share, and that share.

        The rest of a ray's lobe meets something else.

        Args:
            points: (N, 3) where they start, world; directions: (N, 3) unit; roughness: (N,).
        """
        from scipy.special import erf

        normal = np.cross(self.a, self.b)
        height = (points - self.origin) @ normal
        falling = -(directions @ normal)
        there = np.flatnonzero((falling > _GRAZING) & (height > 0))
        found = np.zeros((len(points), 4), np.float32)
        length = height[there] / falling[there]
        met = points[there] + length[:, None] * directions[there] - self.origin
        n = len(self.picture)
        across, down = (((met @ axis) / self.radius + 1) / 2 * n - 0.5 for axis in (self.a, self.b))
        within = (across > -0.5) & (across < n - 0.5) & (down > -0.5) & (down < n - 0.5)
        there, across, down = there[within], across[within], down[within]
        length, falling = length[within], falling[there]
        width = _WIDTH * np.clip(roughness[there], SMOOTHEST, 1) ** 2
        cells = width * length / np.sqrt(falling) * n / (2 * self.radius)
        share = erf(np.arcsin(falling) / (np.sqrt(2) * width))
        found[there] = self._looked_up(across, down, cells) * share[:, None]
        return found

    def levels(self, points: F32, directions: F32) -> F32:
        """(N, K, 4) `mirrored` at each of ROUGHNESSES."""
        at = [self.mirrored(points, directions, np.full(len(points), r)) for r in ROUGHNESSES]
        return np.stack(at, 1)

    def _looked_up(self, across: F64, down: F64, cells: F64) -> F32:
        """(N, 4) at places, in cells, blurred over `cells` (N,)."""
        level = np.clip(np.log2(np.maximum(cells, 0.5)) + 1, 0, len(_BLURS) - 1.001)
        lower = level.astype(np.int64)
        more = (level - lower).astype(np.float32)[:, None]
        fine, coarse = (self._at(across, down, lower + i) for i in (0, 1))
        return np.asarray(fine * (1 - more) + coarse * more, np.float32)

    def _at(self, across: F64, down: F64, level: NDArray[np.int64]) -> F32:
        """(N, 4) bilinear, at a level (N,) of _BLURS."""
        n = len(self.picture)
        x, y = np.clip(across, 0, n - 1.001), np.clip(down, 0, n - 1.001)
        left, top = x.astype(np.int64), y.astype(np.int64)
        u, v = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]
        start = (level * n + top) * n + left
        flat = self._blurred
        upper = flat[start] * (1 - u) + flat[start + 1] * u
        lower = flat[start + n] * (1 - u) + flat[start + n + 1] * u
        return np.asarray(upper * (1 - v) + lower * v, np.float32)


def at_roughness(levels: F32, roughness: F32) -> F32:
    """(N, 4) between `GroundLight.levels` (N, K, 4), for a roughness (N,)."""
    weights = level_weights(np.clip(roughness, SMOOTHEST, 1))
    return np.asarray(sum(w[:, None] * levels[:, i] for i, w in enumerate(weights)), np.float32)
