"""The light that the ground sends: what photos show beside the object, where it lies.

A wall on a board mirrors the board. Each place of the wall mirrors another place of the board, so
light from far away cannot describe this. But the photos show the board itself. Therefore its light
is known, and the photos tell how much of it the wall reflects.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.light import ROUGHNESSES, SMOOTHEST, level_weights

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_BLURS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)  # cells, sigma
_WIDTH = 1.7  # times roughness squared: sigma, radians, of a Gaussian with a GGX lobe's median
_GRAZING = 0.02  # sine of the least angle between a ray and the ground


@dataclass(frozen=True)
class _Met:
    """The M rays that meet the picture.

    Args:
        rays: (M,) numbers; across, down: (M,) in cells; length: (M,) of the rays, world units.
        falling: (M,) sine of the angle between ray and ground.
    """

    rays: Ints
    across: F64
    down: F64
    length: F64
    falling: F64


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
        """(N, 4) what is mirrored of the ground: linear radiance times a share, and that share.

        The share is the part of the roughness's lobe that meets a known place of the ground. What
        the rest of the lobe meets is not included.

        Args:
            points: (N, 3) where rays start, world; directions: (N, 3) unit; roughness: (N,).
        """
        met = self._met(points, directions)
        found = np.zeros((len(points), 4), np.float32)
        found[met.rays] = self._shown(met, roughness[met.rays])
        return found

    def levels(self, points: F32, directions: F32) -> F32:
        """(N, K, 4) `mirrored` at each of ROUGHNESSES.

        Args:
            points: (N, 3) where rays start, world; directions: (N, 3) unit.
        """
        met = self._met(points, directions)
        found = np.zeros((len(points), len(ROUGHNESSES), 4), np.float32)
        for i, roughness in enumerate(ROUGHNESSES):
            found[met.rays, i] = self._shown(met, np.full(len(met.rays), roughness))
        return found

    def _met(self, points: F32, directions: F32) -> "_Met":
        """Where rays that start above the ground meet its picture."""
        normal = np.cross(self.a, self.b)
        height = (points - self.origin) @ normal
        falling = -(directions @ normal)
        rays = np.flatnonzero((falling > _GRAZING) & (height > 0))
        length = height[rays] / falling[rays]
        places = points[rays] + length[:, None] * directions[rays] - self.origin
        n = len(self.picture)
        cells = (places @ np.stack([self.a, self.b], 1) / self.radius + 1) / 2 * n - 0.5
        within = ((cells > -0.5) & (cells < n - 0.5)).all(1)
        rays = rays[within]
        across, down = cells[within].T
        return _Met(rays, across, down, length[within], falling[rays])

    def _shown(self, met: "_Met", roughness: NDArray[Any]) -> F32:
        """(M, 4) what a surface of a roughness (M,) mirrors of these places."""
        from scipy.special import erf

        width = _WIDTH * np.clip(roughness, SMOOTHEST, 1) ** 2
        sigma = width * met.length / np.sqrt(met.falling)
        cells = sigma * len(self.picture) / (2 * self.radius)
        share = erf(np.arcsin(met.falling) / (np.sqrt(2) * width))
        shown = self._looked_up(met.across, met.down, cells) * share[:, None]
        return np.asarray(shown, np.float32)

    def _looked_up(self, across: F64, down: F64, cells: F64) -> F32:
        """(N, 4) at places, in cells, blurred over `cells` (N,)."""
        level = np.clip(np.log2(np.maximum(cells, 0.5)) + 1, 0, len(_BLURS) - 1.001)
        lower = level.astype(np.int64)
        more = (level - lower).astype(np.float32)[:, None]
        fine, coarse = (self._at(across, down, lower + i) for i in (0, 1))
        return np.asarray(fine * (1 - more) + coarse * more, np.float32)

    def _at(self, across: F64, down: F64, level: Ints) -> F32:
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
    """(N, C) between values (N, K, C) at each of ROUGHNESSES, for a roughness (N,)."""
    weights = level_weights(np.clip(roughness, SMOOTHEST, 1))
    return np.asarray(sum(w[:, None] * levels[:, i] for i, w in enumerate(weights)), np.float32)
