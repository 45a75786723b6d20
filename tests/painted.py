"""A small textured mesh with a known picture."""

import numpy as np
from scenes import waves
from solids import sphere

from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.texture.charts import seam_split, unmirrored
from refdgs_pipe.texture.programs import one_by_one_corners
from refdgs_pipe.texture.tangents import mikktspace
from refdgs_pipe.texture.texels import rasterize


def textured(size: int = 256) -> TexturedMesh:
    """A ball of radius 1 at (0, 0, 1), z up, with a known picture and half of it metal."""
    solid = sphere(12, center=(0, 0, 1))
    mesh = seam_split(solid, unmirrored(one_by_one_corners(len(solid.faces))))
    texels = rasterize(mesh, size)
    points = texels.interpolate(mesh, mesh.vertices)

    def texture(values: np.ndarray) -> np.ndarray:
        return texels.picture(np.round(np.clip(values, 0, 1) * 65535).astype(np.uint16))

    flat = np.broadcast_to(np.float32([0.5, 0.5, 1]), points.shape)
    return TexturedMesh(
        mesh,
        mikktspace(mesh),
        base_color=texture(srgb_from_linear(waves(points).astype(np.float32))),
        roughness=texture(0.2 + 0 * points[:, 0]),
        metallic=texture((points[:, 2] > 1).astype(np.float32)),
        occlusion=texture(np.full(len(points), 0.9)),
        normal=texture(flat),
        confidence=texture(np.ones(len(points))),
    )
