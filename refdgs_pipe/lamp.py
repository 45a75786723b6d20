"""A small lamp: what it sheds on a surface, and the highlight that the surface shows of it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.vectors import unit

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Lamp:
    """A point that shines alike to all sides.

    Args:
        place: (3,) world.
        distance: world units, at which a white matte surface that faces it has radiance `white`,
            linear, together with the room's light.
        room: share of that which comes from the room, from all sides.
    """

    place: F32
    distance: float
    white: float
    room: float

    def received(self, points: F32, normals: F32) -> F32:
        """(N, 1) radiance of a white matte surface at points (N, 3) with unit normals (N, 3).

        Lambert's law and the inverse square law. Shadows are neglected: a camera beside the lamp
        hardly sees them.
        """
        _, cosine, falloff = self._towards(points, normals)
        share = self.room + (1 - self.room) * np.maximum(cosine, 0) * falloff
        return np.asarray(self.white * share, np.float32)

    def mirrored(self, points: F32, normals: F32, toward: F32, f0: F32, roughness: F32) -> F32:
        """(N, 3) radiance of the highlight towards the eye, (N, 3) unit.

        The irradiance at `distance` is pi * white * (1 - room); see `highlight`.

        Args:
            f0: (N, 3) reflectance straight on; roughness: (N, 1), the square root of GGX's alpha.
        """
        light, cosine, falloff = self._towards(points, normals)
        half = unit(light + toward)
        n_h = np.clip((normals * half).sum(1, keepdims=True), 0, 1)
        n_v = np.clip((normals * toward).sum(1, keepdims=True), 0.02, 1)
        l_h = np.clip((light * half).sum(1, keepdims=True), 0, 1)
        n_l = np.maximum(cosine, 0)
        irradiance = np.pi * self.white * (1 - self.room) * n_l * falloff
        lobe = highlight(n_h, n_l, l_h, n_v, f0, roughness)
        return np.asarray(irradiance * lobe, np.float32)

    def _towards(self, points: F32, normals: F32) -> tuple[F32, F32, F32]:
        """(N, 3) unit to the lamp; (N, 1) cosine to the normal and factor of the distance."""
        apart = self.place - points
        length = np.linalg.norm(apart, axis=1, keepdims=True).clip(min=1e-6)
        light = apart / length
        cosine = (light * normals).sum(1, keepdims=True)
        return light, cosine, (np.float32(self.distance) / length) ** 2


def highlight(n_h: Any, n_l: Any, l_h: Any, n_v: Any, f0: Any, roughness: Any) -> Any:
    """(N, 3) of the irradiance that is mirrored, per steradian; numpy arrays or torch tensors.

    Cook-Torrance with GGX, Smith's masking by Schlick and Schlick's Fresnel (Karis 2013, "Real
    Shading in Unreal Engine 4").

    Args:
        n_h, n_l, l_h, n_v: (N, 1) cosines between normal, lamp, eye and half vector, at least 0.
        f0: (N, 3) reflectance straight on; roughness: (N, 1), the square root of GGX's alpha.
    """
    alpha2 = roughness**4
    lobe = alpha2 / (np.pi * (n_h**2 * (alpha2 - 1) + 1) ** 2)
    k = (roughness + 1) ** 2 / 8
    masking = 1 / (4 * (n_v * (1 - k) + k) * (n_l * (1 - k) + k))
    return lobe * masking * (f0 + (1 - f0) * (1 - l_h) ** 5)
