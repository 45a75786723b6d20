"""The light that matte surfaces get, in the mean over photos between which the light moves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.lighting import WORLD, Lighting
from refdgs_pipe.irradiance import Sky
from refdgs_pipe.light import Environment, looked_up, texel_directions

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
WHITE, BRIGHTEST = 0.8, 0.95  # reflectance of white paint, and the quantile that may be as white
_TURNS = 24  # rooms that are averaged at most


@dataclass(frozen=True)
class MeanLight:
    """How the light moves, and for which photos.

    Args:
        lighting: how it moves.
        turns: (K, 3, 3) rotations of world directions into the room, of a turntable's photos.
        white: of `Appearance`; 0 without a flash.
    """

    lighting: Lighting = WORLD
    turns: F64 | None = None
    white: float = 0.0

    @classmethod
    def of(cls, lighting: Lighting, centers: list[F64], diffuse: F32) -> "MeanLight":
        """Of photos taken at `centers`, each (3,).

        Args:
            diffuse: (N, 3) linear diffuse radiance of the field's object.
        """
        if lighting.kind == "turntable":
            some = np.unique(np.linspace(0, len(centers) - 1, _TURNS).round().astype(int))
            turns = np.stack([lighting.light_from_world(centers[i]) for i in some])
            return cls(lighting, turns)
        if lighting.kind == "flash":
            bright = float(np.quantile(diffuse.max(1), BRIGHTEST)) if len(diffuse) else 0.0
            return cls(lighting, white=max(bright / WHITE, 0.05))
        return cls(lighting)

    def received(self, picture: F32, sky: Sky, sent: F32) -> F32:
        """(V, 3) radiance of a white matte surface at each vertex.

        A flash sheds the same on all that faces it at its distance: the field has taken slope and
        distance out of its diffuse radiance.

        Args:
            picture: (H, 2H, 3) far light, in the frame where it stands still.
            sent: (V, 3) radiance that the mesh's vertices send out.
        """
        if self.white:
            return np.full_like(sent, self.white)
        return sky.received(Environment(self.seen_by_all(picture)), sent)

    def seen_by_all(self, picture: F32) -> F32:
        """(H, 2H, 3) the mean of the far light over all photos, in the world's frame."""
        if self.turns is None:
            return picture
        around = texel_directions(len(picture))
        total = np.zeros_like(picture)
        for turn in self.turns:
            total += looked_up(picture, around @ turn.T)
        return np.asarray(total / np.float32(len(self.turns)), np.float32)
