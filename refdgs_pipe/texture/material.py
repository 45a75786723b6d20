"""From what was gathered per texel to the textures of a metallic-roughness material."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.texture.baking import Gather, Surface
from refdgs_pipe.texture.tangents import mikktspace, tangent_space
from refdgs_pipe.texture.texels import Texels, rasterize

F32 = NDArray[np.float32]

# The mean light that falls on the object, in exposed units, is not known. Photos are exposed so
# that it is rarely darker than this; where the brighter reflections average more than a mirror
# could give under it, it must be brighter.
_LIGHT = 0.3
_MIRROR = 0.95
# Reflectances between these two turn from plastic to metal (plastics: 0.04, iron: 0.5).
_PLASTIC, _METAL = 0.15, 0.4


@dataclass(frozen=True)
class Reflectance:
    """The split of a surface: base (N, 3) linear colour and metallic (N,)."""

    base: F32
    metallic: F32


def reflectance(surface: Surface) -> Reflectance:
    """Tell metal from the rest by how much of the light it reflects, averaged over all views.

    A metal has no diffuse colour: rendered as a plastic it would be black. Its base colour is
    its reflectance: the mean reflected radiance over the mean light.
    """
    seen = surface.specular[surface.seen].astype(np.float64)
    light = max(_LIGHT, float((seen**2).sum() / max(seen.sum(), 1e-9)) / _MIRROR)
    mirror = np.clip(surface.specular / light, 0, _MIRROR)
    step = np.clip((mirror.mean(1) - _PLASTIC) / (_METAL - _PLASTIC), 0, 1)
    metallic = step * step * (3 - 2 * step)
    # A surface that scatters more than it mirrors is a bright glossy plastic.
    body = surface.diffuse.mean(1)
    metallic *= np.clip(2 * mirror.mean(1) / np.maximum(mirror.mean(1) + body, 1e-6) - 0.5, 0, 1)
    base = surface.diffuse * (1 - metallic[:, None]) + mirror * metallic[:, None]
    return Reflectance(base.astype(np.float32), metallic.astype(np.float32))


def plain(surface: Surface) -> Reflectance:
    """No metal anywhere: the diffuse colour alone."""
    return Reflectance(surface.diffuse, np.zeros_like(surface.roughness))


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

    def paint(self, *, metal: bool) -> TexturedMesh:
        """The textures; `metal` tells metal from the rest by what it reflects.

        Raises:
            MeshError: no view saw any part of the mesh.
        """
        surface = self._gather.surface()
        self.seen_share = float(surface.seen.mean())
        split = reflectance(surface) if metal else plain(surface)
        return _painted(self.mesh, self._texels, surface, split)


def _painted(mesh: UvMesh, texels: Texels, surface: Surface, split: Reflectance) -> TexturedMesh:
    """The mesh with every texture filled, also between the charts."""
    tangents = mikktspace(mesh)
    normal = tangent_space(texels, mesh, tangents, surface.normal)
    return TexturedMesh(
        mesh,
        tangents,
        base_color=_texture(texels, srgb_from_linear(split.base)),
        roughness=_texture(texels, surface.roughness),
        metallic=_texture(texels, split.metallic),
        normal=_texture(texels, normal * 0.5 + 0.5),
        confidence=_texture(texels, surface.confidence),
    )


def _texture(texels: Texels, values: F32) -> NDArray[np.uint16]:
    coded = np.round(np.clip(values, 0, 1) * 65535).astype(np.uint16)
    return np.asarray(texels.picture(coded), np.uint16)
