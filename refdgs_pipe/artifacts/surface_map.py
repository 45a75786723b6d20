"""What one camera sees of a surface. After this nothing knows what a Gaussian is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import Camera

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class SurfaceMap:
    """Maps of one view, all (H, W[, 3]) float32 and aligned with the camera's pixels.

    Args:
        depth: camera z in world units; 0 where there is no surface.
        alpha: coverage in [0, 1].
        normal: unit, world space, facing the camera; 0 where there is no surface.
        diffuse: linear, free of reflections, not premultiplied.
        specular: linear radiance of the reflections, not premultiplied.
        roughness: [0, 1], not premultiplied (square root of the GGX alpha).
        color: the final picture over black, sRGB-encoded.
    """

    camera: Camera
    depth: F32
    alpha: F32
    normal: F32
    diffuse: F32
    specular: F32
    roughness: F32
    color: F32
