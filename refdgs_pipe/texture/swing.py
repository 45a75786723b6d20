"""Metal and roughness, told by how much a place's reflections swing from view to view.

A surface sends light * reflectance, so that over the views of one place the deviation of what it
mirrors is that of the light it mirrors, blurred, times its reflectance. This asks for no correct
normal: a wrong one mirrors other light, but light that varies as much. Least squares would take
every misplaced reflection for a rougher surface.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.light import DIELECTRIC, Environment, reflected_share
from refdgs_pipe.received import spread
from refdgs_pipe.texture.sampling import Samples, seen_roughness

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]

_FAINT = 0.06  # light that varies less than this, linear, tells little about what mirrors it
_SMOOTHING = 4
_GRID = (0.1, 0.13, 0.16, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7, 1.0)
_REFLECTANCES = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7, 1.0, 1.4)


@dataclass(frozen=True)
class Swing:
    """Deviations over the samples (N) around each vertex (V) of a mesh.

    Args:
        samples: what the views show.
        corners: sparse (N, V), from vertices to samples.
        near: (N, 3) radiance that mirrored rays meet on the mesh.
        links: (E, 2) neighbouring vertices.
    """

    samples: Samples
    corners: Any
    near: F32
    links: Ints

    def reflectance(self, light: Environment, roughness: F32) -> F32:
        """(V,) the reflectance with which a vertex's reflections swing as they are seen to do.

        Compared as photos show them, clipped at white: what is brighter swings without end in the
        light that was found, and not in what was seen.

        Args:
            roughness: (V,) as far as it is known.
        """
        mirrored = self._mirrored(light, np.asarray(self.corners @ roughness, np.float32))
        seen = np.maximum(self._deviation(np.clip(self.samples.specular, 0, 1)), 1e-5)
        excess = np.empty((len(_REFLECTANCES), len(seen)), np.float32)
        for i, value in enumerate(_REFLECTANCES):
            shown = self._deviation(np.clip(np.float32(value) * mirrored, 0, 1))
            excess[i] = np.log(seen / np.hypot(shown, np.float32(value * _FAINT)))
        return _crossing(np.asarray(_REFLECTANCES, np.float32), excess)

    def roughness(self, light: Environment, metallic: F32, tint: F32) -> F32:
        """(V,) the roughness with which a vertex's reflections swing as they are seen to do.

        Where a metal is, photos are asked, which are sharper than the field: all that a metal sends
        is mirrored, and what does not swing is left out.
        """
        metal = metallic[:, None]
        f0 = np.asarray(self.corners @ (DIELECTRIC * (1 - metal) + tint * metal), np.float32)
        cosine = np.clip(self.samples.cosine, 0.02, 1)[:, None]
        far = (self.samples.near_face < 0).astype(np.float32)
        split = self._deviation(np.clip(self.samples.specular, 0, 1), far)
        photo = np.clip(self.samples.photo - self.samples.diffuse, 0, 1)
        whole = self._deviation(photo, far)
        seen = np.maximum(split + metallic * (whole - split), 1e-5)
        excess = np.empty((len(_GRID), len(seen)), np.float32)
        for i, value in enumerate(_GRID):
            rough = np.full(len(cosine), value, np.float32)
            share = reflected_share(f0, rough[:, None], cosine)
            shown = self._deviation(np.clip(self._mirrored(light, rough) * share, 0, 1), far)
            excess[i] = np.log(np.maximum(shown, 1e-6) / seen)
        return _crossing(np.asarray(_GRID, np.float32), excess)

    def _mirrored(self, light: Environment, rough: F32) -> F32:
        far = light.mirrored(self.samples.mirrored, seen_roughness(rough, self.samples.footprint))
        return np.where(self.samples.near_face[:, None] < 0, far, self.near)

    def _deviation(self, values: F32, counted: F32 | None = None) -> F32:
        """(V,) standard deviation over the samples around each vertex, those that are counted."""
        here = np.ones((len(values), 1), np.float32) if counted is None else counted[:, None]
        weight = np.asarray(self.corners.T @ here, np.float32)
        first = np.asarray(self.corners.T @ (here * values), np.float32)
        second = np.asarray(self.corners.T @ (here * values * values), np.float32)
        known = np.maximum(weight, 1e-6)
        spread_out = np.maximum(second - first * first / known, 0)
        both = np.concatenate([spread_out.mean(1, keepdims=True), weight], 1).astype(np.float32)
        for _ in range(_SMOOTHING):
            both = spread(both, self.links)
        return np.asarray(np.sqrt(both[:, 0] / np.maximum(both[:, 1], 1e-6)), np.float32)


def _crossing(grid: F32, excess: F32) -> F32:
    """(V,) where falling rows (G, V) over a grid (G,) cross zero, or the end that is nearer."""
    above = np.clip((excess > 0).sum(0), 1, len(grid) - 1)
    column = np.arange(excess.shape[1])
    high, low = excess[above - 1, column], excess[above, column]
    part = np.clip(high / np.maximum(high - low, 1e-6), 0, 1)
    return np.asarray(grid[above - 1] + part * (grid[above] - grid[above - 1]), np.float32)
