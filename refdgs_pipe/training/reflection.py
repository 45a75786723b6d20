"""Far and near reflections of a pixel: the Sph-Mip lookup, the mixing, the shader."""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn

from refdgs_pipe.ops import mlp, sph_mip

FLASH_ROWS = 64  # of the map in the camera's frame
RADIANCE_EXPONENT = 5.0  # specular radiance is at most e^5


class Shader(nn.Module):
    """The learnable far-field map and the MLP that turns features into specular radiance.

    Sph-Mip map (H, 2H, 4), zeros at first; MLP with 3 hidden layers of 64, ReLU, whose output is
    exp(min(x, 5)), at first about 0.25 (method: Ref-DGS). `half`: see `ops.mlp`. `flash`: a second
    map, (64, 128, 4), in the camera's frame, for a lamp that moves with it.
    """

    def __init__(
        self,
        height: int,
        local: str,
        mixing: str,
        physical: bool,
        *,
        half: bool = False,
        flash: bool = False,
    ) -> None:
        super().__init__()
        self.half_products = half
        self.local, self.mixing, self.physical = local, mixing, physical
        inputs = 4 + (4 if mixing == "adaptive" and local != "none" else 0) + (2 if physical else 0)
        inputs += 4 if flash else 0
        self.environment = nn.Parameter(torch.zeros(height, 2 * height, 4))
        rows = torch.zeros(FLASH_ROWS, 2 * FLASH_ROWS, 4) if flash else None
        self.flash = None if rows is None else nn.Parameter(rows)
        layers = [nn.Linear(a, b) for a, b in pairwise([inputs, 64, 64, 64, 3])]
        nn.init.constant_(layers[-1].bias, math.log(0.25))
        self.weights = nn.ParameterList(layer.weight for layer in layers)
        self.biases = nn.ParameterList(layer.bias for layer in layers)

    def maps(self) -> list[nn.Parameter]:
        """The far field's, and the flash's if there is one."""
        return [self.environment] if self.flash is None else [self.environment, self.flash]


def specular(
    shader: Shader,
    reflected: Tensor,
    roughness: Tensor,
    cosine: Tensor,
    near: Tensor | None,
    limit: Tensor | None = None,
    *,
    from_camera: Tensor | None = None,
) -> Tensor:
    """(P, 3) linear specular radiance (Ref-DGS).

    Args:
        reflected: (P, 3) unit, where the mirrored view ray goes.
        roughness, cosine: (P,).
        near: (P, 4) local reflection features, or None.
        limit: see `ops.mlp`.
        from_camera: (P, 3) `reflected` in the camera's frame, for a shader with a flash. None: what
            is mirrored there holds no lamp, as in directions that lead away from the camera.
    """
    far = sph_mip(shader.environment, reflected, roughness, limit=limit)
    parts = [far]
    if shader.local != "none":
        near = torch.zeros_like(far) if near is None else near
        parts = [far + near] if shader.mixing == "sum" else [far, near]
    if shader.flash is not None:
        lamp = _flash_features(shader.flash, far, from_camera, roughness, limit)
        parts[0] = torch.cat([parts[0], lamp], -1)  # the network takes four tables at most
    if shader.physical:
        parts += [roughness, cosine]
    weights, biases = list(shader.weights), list(shader.biases)
    half = shader.half_products
    return mlp(parts, weights, biases, exp_cap=RADIANCE_EXPONENT, half=half, limit=limit)


def _flash_features(
    lamp: Tensor, far: Tensor, from_camera: Tensor | None, roughness: Tensor, limit: Tensor | None
) -> Tensor:
    """(P, 4) of the map (H, 2H, 4) in the camera's frame."""
    if from_camera is None:
        from_camera = torch.zeros_like(far[:, :3])
        from_camera[:, 2] = 1  # the camera looks along +z
    return sph_mip(lamp, from_camera, roughness, limit=limit)
