"""Far and near reflections of a pixel: the Sph-Mip lookup, the mixing, the shader."""

import torch
import torch.nn.functional as F
from torch import Tensor

from refdgs_pipe.ops import sph_mip
from refdgs_pipe.training.surfels import Shader


def specular(
    shader: Shader, reflected: Tensor, roughness: Tensor, cosine: Tensor, near: Tensor | None
) -> Tensor:
    """(P, 3) linear specular radiance (Ref-DGS).

    Args:
        reflected: (P, 3) unit, where the mirrored view ray goes.
        roughness, cosine: (P,).
        near: (P, 4) local reflection features, or None.
    """
    far = sph_mip(shader.environment, reflected, roughness)
    parts = [far]
    if shader.local != "none":
        near = torch.zeros_like(far) if near is None else near
        parts = [far + near] if shader.mixing == "sum" else [far, near]
    if shader.physical:
        parts += [roughness[:, None], cosine[:, None]]
    x = torch.cat(parts, -1)
    for layer in shader.layers[:-1]:
        x = F.relu(layer(x))
    return torch.exp(shader.layers[-1](x).clamp(max=5.0))
