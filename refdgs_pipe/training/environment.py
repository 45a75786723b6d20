"""The far surroundings of a trained field, as a mirror shows them."""

import numpy as np
import torch
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.light import texel_directions
from refdgs_pipe.training.reflection import specular
from refdgs_pipe.training.render import shader_of

F32 = NDArray[np.float32]
ROUGHNESS, COSINE = 0.0, 1.0
_USUAL_COSINE = 0.7


def mirrored_light(
    field: SurfelField, directions: F32, *, roughness: float = ROUGHNESS, cosine: float = COSINE
) -> F32 | None:
    """Linear specular radiance that comes from far away out of each direction; None if matte.

    What is decoded is what a surface of that roughness (0: a perfect mirror) would send to an eye
    at that cosine to its normal (1: straight on), without reflections of near things. The shader's
    output is light times reflectance: radiances are relative, and directions that no photo saw
    mirrored hold whatever training left there.

    Args:
        directions: (..., 3) unit, world: from the object outwards.

    Returns:
        (..., 3) radiance, at least 0.
    """
    shader = shader_of(field, "cpu")
    if shader is None:
        return None
    flat = torch.from_numpy(np.ascontiguousarray(directions.reshape(-1, 3), np.float32))
    count = len(flat)
    with torch.no_grad():
        radiance = specular(
            shader, flat, torch.full((count,), roughness), torch.full((count,), cosine), None
        )
    return np.asarray(radiance.numpy().reshape(directions.shape), np.float32)


def typical_light(field: SurfelField, roughness: F32, specular_seen: F32, height: int) -> F32:
    """(height, 2 height, 3) the light as the surfaces that mirror most were seen to mirror it.

    Decoded for the roughness and a cosine that training met; laid out as `refdgs_pipe.light` says.

    Args:
        roughness: (N,) of places that were seen; specular_seen: (N, 3) what they mirrored.
    """
    weights = specular_seen.mean(1)
    usual = float((roughness * weights).sum() / max(float(weights.sum()), 1e-9))
    directions = texel_directions(height).astype(np.float32)
    found = mirrored_light(field, directions, roughness=usual, cosine=_USUAL_COSINE)
    assert found is not None
    return found
