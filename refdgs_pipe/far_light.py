"""What a surface mirrors beside the object: light from far away, and the light of the near ground.

The far picture shows the ground too, as the middle of the object sees it. Other places mirror other
parts of the ground. So the far picture is split into the ground and the rest. A place mirrors the
ground that it sees itself, and the rest of the far picture. Otherwise the ground would count twice.
"""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.ground_light import GroundLight
from refdgs_pipe.light import ROUGHNESSES, SMOOTHEST, Environment, texel_directions

F32 = NDArray[np.float32]
Bools = NDArray[np.bool_]

_LEAST = 1e-3  # share of a lobe by which light is divided, at least


def ground_seen(ground: GroundLight | None, vertices: F32, height: int) -> tuple[F32, Bools]:
    """The ground from the middle of a mesh: linear radiance (H * 2H, 3), and (H * 2H,) where.

    Args:
        vertices: (V, 3) of the mesh, world.
        height: H, rows of the far picture.
    """
    away = texel_directions(height).astype(np.float32).reshape(-1, 3)
    if ground is None:
        return np.zeros_like(away), np.zeros(len(away), np.bool_)
    middle = np.broadcast_to((vertices.min(0) + vertices.max(0)) / 2, away.shape)
    met = ground.mirrored(middle, away, np.full(len(away), SMOOTHEST, np.float32))
    share = met[:, 3]
    told = met[:, :3] / np.maximum(share, np.float32(1e-6))[:, None]
    return np.asarray(told, np.float32), share > 0.5


class FarLight:
    """A far picture, split into the ground and the rest.

    Args:
        light: (H * 2H, 3) linear radiance; its texels that show the ground hold the ground's.
        known: (H * 2H,) those texels.
    """

    def __init__(self, light: F32, known: Bools) -> None:
        apart = known[:, None]
        height = round((len(light) / 2) ** 0.5)

        def picture(values: F32) -> Environment:
            return Environment(values.reshape(height, 2 * height, -1).astype(np.float32))

        self.rest = picture(np.where(apart, 0, light))
        self._ground = picture(np.where(apart, light, 0))
        self._share = picture(np.repeat(apart, 3, axis=1))

    def near(self, met: F32, directions: F32, roughness: F32) -> F32:
        """(N, 3) linear radiance of the ground in mirrored lobes; `rest` adds the other light.

        Where a place meets less of the ground than the far picture has in the lobe, the far
        picture's ground fills the gap.

        Args:
            met: (N, 4) of `GroundLight.mirrored`; directions: (N, 3) unit; roughness: (N,).
        """
        below = self._ground.mirrored(directions, roughness)
        known = np.clip(self._share.mirrored(directions, roughness)[:, :1], 0, 1)
        share = met[:, 3:]
        kept = np.minimum(1, known / np.maximum(share, _LEAST))
        missing = np.clip(1 - share / np.maximum(known, _LEAST), 0, 1)
        return np.asarray(met[:, :3] * kept + missing * below, np.float32)

    def levels(self, met: F32, directions: F32) -> F32:
        """(N, K, 3) `near` at each of ROUGHNESSES.

        Args:
            met: (N, K, 4) of `GroundLight.levels`; directions: (N, 3) unit.
        """
        found = np.empty_like(met[..., :3])
        for i, roughness in enumerate(ROUGHNESSES):
            found[:, i] = self.near(met[:, i], directions, np.full(len(met), roughness, np.float32))
        return found

    def mirrored(self, ground: GroundLight, points: F32, directions: F32, roughness: F32) -> F32:
        """(N, 3) linear radiance that mirrored rays (N, 3) from points (N, 3), world, meet."""
        met = self.near(ground.mirrored(points, directions, roughness), directions, roughness)
        return met + self.rest.mirrored(directions, roughness)
