"""How bright the light is at least, and of what colour: photos are exposed and balanced for it.

Photos show the product of light and reflectance. Lamps, windows and the sun are clipped in them, so
mirrors show them too dim, and a fit to what mirrors show finds too little light. Two things bound
the light from below: cameras expose so that white matte surfaces come out bright, and nothing on
the ground reflects more than white paint does.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refdgs_pipe.ground_light import GroundLight
from refdgs_pipe.light import solid_angles, texel_directions
from refdgs_pipe.texture.mean_light import BRIGHTEST, WHITE

F32 = NDArray[np.float32]

# ISO 12232, speed by saturation: a surface that reflects 0.18 shows 0.18 / sqrt(2) of white.
STANDARD = 2**-0.5
_HELD = 0.01  # loss for less light, for each squared logarithm
_CAST = 0.25  # share of its colour cast, in logarithms, that the first guess of the light keeps
_KNOWN = 0.5  # share of a cell of the ground that photos must show


@dataclass(frozen=True)
class LeastLight:
    """The least light that reaches a matte surface that faces up.

    Args:
        weights: (H * 2H,) how much each texel of the far light counts there; their sum is one.
        least: the linear radiance that the surface shows at least, if it is white.
    """

    weights: F32
    least: float

    def missing(self, light: Tensor) -> Tensor:
        """The loss for too little light, a number.

        Args:
            light: (H * 2H, 3) linear radiance.
        """
        received = (torch.from_numpy(self.weights)[:, None] * light).sum(0).mean()
        return _HELD * (float(np.log(self.least)) - received.log()).clamp(min=0) ** 2


def least_light(ground: GroundLight | None, vertices: F32, height: int) -> LeastLight | None:
    """The least light above a ground whose light is known; None if it is not.

    Args:
        vertices: (V, 3) of the object's mesh, world, on the ground's upper side.
        height: H, rows of the far light.
    """
    if ground is None:
        return None
    up = np.cross(ground.a, ground.b)
    up = up if up @ (vertices.mean(0) - ground.origin) >= 0 else -up
    facing = np.maximum(texel_directions(height).reshape(-1, 3) @ up, 0)
    weights = facing * solid_angles(height).reshape(-1)
    light, share = ground.picture[..., :3].mean(-1), ground.picture[..., 3]
    known = share > _KNOWN
    white = 0.0
    if known.any():
        white = float(np.quantile(light[known] / share[known], BRIGHTEST)) / WHITE
    return LeastLight((weights / weights.sum()).astype(np.float32), max(STANDARD, white))


def balanced(light: F32) -> F32:
    """(H, 2H, 3) the first guess of the light, with less of a colour cast.

    The field tells only the product of light and reflectance, so this guess has the colour of what
    mirrors the light. Cameras balance photos so that the light is about white.
    """
    size = solid_angles(len(light))[..., None]
    mean = np.maximum((size * light).sum((0, 1)) / size.sum(), 1e-6)
    cast = mean / np.exp(np.log(mean).mean())
    return np.asarray(light * cast ** (_CAST - 1), np.float32)
