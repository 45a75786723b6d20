"""The materials of an asset, looked up in its textures as the exported pictures have them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.light import DIELECTRIC, SMOOTHEST

F32 = NDArray[np.float32]
U16 = NDArray[np.uint16]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Shaded:
    """What the asset is at N places: base (N, 3) linear; roughness, metallic (N, 1)."""

    base: F32
    roughness: F32
    metallic: F32

    @property
    def scattered(self) -> F32:
        """(N, 3) share of the light received that is scattered."""
        return self.base * (1 - self.metallic)

    @property
    def f0(self) -> F32:
        """(N, 3) reflectance straight on."""
        return DIELECTRIC * (1 - self.metallic) + self.base * self.metallic


class AssetTextures:
    """The textures of an asset in the 256 steps that the exported pictures have.

    All the bytes of a texel lie in one word, so that a lookup reads memory once.

    Args:
        base_color: (S, S, 3) sRGB; roughness, metallic: (S, S); normal: (S, S, 3); 16 bits each.
    """

    def __init__(self, base_color: U16, roughness: U16, metallic: U16, normal: U16) -> None:
        layers = (base_color, roughness[..., None], metallic[..., None], normal)
        eight = [((layer.astype(np.uint32) + 128) // 257).astype(np.uint8) for layer in layers]
        self._words = np.concatenate(eight, -1).view(np.uint64).reshape(-1)
        self.size = len(base_color)
        self._plain = np.arange(256, dtype=np.float32) / np.float32(255)
        self._linear = linear_from_srgb(self._plain)

    def at(self, uv: F32) -> F32:
        """(N, 8) base colour, linear; roughness; metallic; normal as 0 to 1: bilinear lookups.

        Args:
            uv: (N, 2) texture coordinates.
        """
        x, y = np.clip(uv * self.size - 0.5, 0, self.size - 1.001).T
        left, top = x.astype(int), y.astype(int)
        right, below = np.minimum(left + 1, self.size - 1), np.minimum(top + 1, self.size - 1)
        across, down = (x - left)[:, None], (y - top)[:, None]
        upper = self._texels(top, left) * (1 - across) + self._texels(top, right) * across
        lower = self._texels(below, left) * (1 - across) + self._texels(below, right) * across
        return np.asarray(upper * (1 - down) + lower * down, np.float32)

    def _texels(self, row: Ints, column: Ints) -> F32:
        """(N, 8) the texels of some rows (N,) and columns (N,)."""
        found = np.take(self._words, row * self.size + column).view(np.uint8).reshape(-1, 8)
        values = self._plain[found]
        values[:, :3] = self._linear[found[:, :3]]
        return values


def material_of(texels: F32) -> Shaded:
    """The material of texels (N, 8) as `AssetTextures.at` gives them."""
    return Shaded(texels[:, :3], np.maximum(texels[:, 3:4], SMOOTHEST), texels[:, 4:5])
