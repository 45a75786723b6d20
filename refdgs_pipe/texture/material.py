"""From what was gathered per texel to the textures of a metallic-roughness material."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.texture.baking import Surface
from refdgs_pipe.texture.tangents import tangent_space
from refdgs_pipe.texture.texels import Texels

F32 = NDArray[np.float32]

# The mean light that falls on the object, in exposed units, is not known. Photos are exposed so
# that it is rarely darker than this; a brighter reflection than any mirror could give raises it.
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
    seen = surface.specular[surface.seen]
    light = max(_LIGHT, float(np.quantile(seen.max(1), 0.99)) / _MIRROR)
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


def painted(
    mesh: UvMesh, tangents: F32, texels: Texels, surface: Surface, split: Reflectance
) -> TexturedMesh:
    """The mesh with every texture filled, also between the charts."""
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
