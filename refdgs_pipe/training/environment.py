"""The far surroundings of a trained field, as a mirror shows them."""

import numpy as np
import torch
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.training.reflection import specular
from refdgs_pipe.training.render import shader_of

F32 = NDArray[np.float32]
ROUGHNESS, COSINE = 0.0, 1.0


def mirrored_light(field: SurfelField, directions: F32) -> F32 | None:
    """Linear specular radiance that comes from far away out of each direction; None if matte.

    What is decoded is what a perfect mirror (roughness 0) would send to an eye that looks straight
    at it (cosine 1), without reflections of near things. The shader's output is light times
    reflectance, which photos of one object cannot tell apart: radiances are relative, and
    directions that no photo saw mirrored hold whatever training left there.

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
            shader, flat, torch.full((count,), ROUGHNESS), torch.full((count,), COSINE), None
        )
    return np.asarray(radiance.numpy().reshape(directions.shape), np.float32)
