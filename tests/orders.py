"""What delivery targets are made from: a dented ball with charts and a known picture."""

from functools import cache, partial
from pathlib import Path

import finished
import numpy as np
from scenes import orbit, waves
from solids import sphere

from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.export import files
from refdgs_pipe.export.files import Surroundings
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.product import product
from refdgs_pipe.export.targets.order import Order
from refdgs_pipe.texture.charts import unwrap
from refdgs_pipe.texture.levels import level
from refdgs_pipe.texture.tangents import mikktspace
from refdgs_pipe.texture.texels import rasterize

UP = np.array([0.0, 0.0, 1.0])
METRES = 0.1  # for a unit of the world


@cache
def dented(rings: int = 40, size: int = 1024, *, is_open: bool = False) -> TexturedMesh:
    """A dented ball of radius 1, z up; open: without its lowest eighth."""
    solid = sphere(rings)
    shaped = solid.vertices * (1 + 0.1 * np.sin(4 * solid.vertices).prod(1, keepdims=True))
    faces = solid.faces
    if is_open:
        faces = faces[solid.vertices[faces][..., 2].min(1) > -0.75]
    whole = Mesh(shaped.astype(np.float32), faces)
    mesh = unwrap(whole, gutter=4 / size, max_stretch=0.1667, timeout_s=120).mesh
    texels = rasterize(mesh, size)
    points = texels.interpolate(mesh, mesh.vertices)

    def texture(values: np.ndarray) -> np.ndarray:
        return texels.picture(np.round(np.clip(values, 0, 1) * 65535).astype(np.uint16))

    flat = np.float32([0.5, 0.5, 1]) + 0 * points
    flat[:, 0] += 0.1 * np.sin(20 * points[:, 2])
    return TexturedMesh(
        mesh,
        mikktspace(mesh),
        base_color=texture(srgb_from_linear(waves(points).astype(np.float32))),
        roughness=texture(0.3 + 0.1 * np.sin(5 * points[:, 0])),
        metallic=texture((points[:, 2] > 0).astype(np.float32)),
        occlusion=texture(np.full(len(points), 0.9)),
        normal=texture(flat),
        confidence=texture(np.ones(len(points))),
    )


def order_in(folder: Path, textured: TexturedMesh, *, unknown: str = "") -> Order:
    """An order beside its asset.glb; unknown: what is said of a size that is not known."""
    around = Surroundings(
        AssetFrame.of(UP, METRES),
        np.ones((8, 16, 3), np.float32),
        orbit(2),
        finished.field().geometry,
    )
    turned = partial(product, up=UP, metres_per_unit=METRES, about={"photos": ["a.jpg"]})
    size = unknown or "0.2 m, given"
    coarser = partial(level, textured)
    made = Order(folder, textured, around, turned, coarser, None, size, not unknown)
    files.glb(folder, made.product)
    return made
