"""From what was gathered per texel to the textures of a metallic-roughness material."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.texture.baking import Gather, Surface
from refdgs_pipe.texture.tangents import mikktspace, tangent_space
from refdgs_pipe.texture.texels import Texels, rasterize
from refdgs_pipe.texture.trust import ShapeErrors

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Materials:
    """What each of N texels is made of; (N, 3) or (N,) float32."""

    base: F32
    roughness: F32
    metallic: F32
    openness: F32


def materials(surface: Surface, mesh: UvMesh, texels: Texels, looks: Appearance) -> Materials:
    """The materials of a mesh's vertices, in the texels' finer detail.

    A metal has no diffuse colour: its base colour is its reflectance. Elsewhere it is the share
    of the light received that the surface scatters.
    """
    table = np.concatenate(
        [
            looks.roughness[:, None],
            looks.metallic[:, None],
            looks.openness[:, None],
            looks.gain / looks.received,
            looks.tint,
        ],
        axis=1,
    )
    there = texels.interpolate(mesh, table[nearest(looks.points, mesh.vertices)])
    metallic = there[:, 1:2]
    scattered = np.clip(surface.diffuse * there[:, 3:6], 0, 1)
    base = scattered * (1 - metallic) + there[:, 6:9] * metallic
    return Materials(base, there[:, 0], metallic[:, 0], there[:, 2])


def nearest(points: F32, wanted: F32) -> NDArray[np.int64]:
    """(N,) which of the points is nearest; a mesh and its charts have the same ones."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(points).query(wanted)[1], np.int64)


class Painter:
    """Paints a mesh from the maps of one view after another.

    Args:
        size: side of the textures in texels, a power of two.
        tolerance: how far the maps may lie off the mesh, world units.
    """

    def __init__(self, mesh: UvMesh, size: int, *, tolerance: float) -> None:
        self.mesh, self.seen_share = mesh, 0.0
        self._texels = rasterize(mesh, size)
        normals = self._texels.interpolate(mesh, mesh.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        points = self._texels.interpolate(mesh, mesh.vertices)
        self._gather = Gather(points, normals, tolerance=tolerance)

    def add(self, view: SurfaceMap) -> None:
        """Take what one view shows."""
        self._gather.add(view)

    def paint(self, looks: Appearance, errors: ShapeErrors | None = None) -> TexturedMesh:
        """The textures, for materials that were told for the mesh's vertices.

        Args:
            errors: to be expected of the shape; without them, what a view saw counts as exact.

        Raises:
            MeshError: no view saw any part of the mesh.
        """
        surface = self._gather.surface()
        self.seen_share = float(surface.seen.mean())
        made_of = materials(surface, self.mesh, self._texels, looks)
        confidence = surface.seen.astype(np.float32)
        if errors is not None:
            points = self._texels.interpolate(self.mesh, self.mesh.vertices)
            confidence *= errors.confidence(points)
        return _painted(self.mesh, self._texels, surface, made_of, confidence)


def _painted(
    mesh: UvMesh, texels: Texels, surface: Surface, made_of: Materials, confidence: F32
) -> TexturedMesh:
    """The mesh with every texture filled, also between the charts."""
    tangents = mikktspace(mesh)
    normal = tangent_space(texels, mesh, tangents, surface.normal)
    return TexturedMesh(
        mesh,
        tangents,
        base_color=_texture(texels, srgb_from_linear(made_of.base)),
        roughness=_texture(texels, made_of.roughness),
        metallic=_texture(texels, made_of.metallic),
        occlusion=_texture(texels, made_of.openness),
        normal=_texture(texels, normal * 0.5 + 0.5),
        confidence=_texture(texels, confidence),
    )


def _texture(texels: Texels, values: F32) -> NDArray[np.uint16]:
    coded = np.round(np.clip(values, 0, 1) * 65535).astype(np.uint16)
    return np.asarray(texels.picture(coded), np.uint16)
