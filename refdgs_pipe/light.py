"""Light from far away, in lat-long pictures, and what a surface makes of it.

Pictures are (H, 2H, 3) linear radiance with the pole at +z of the world: the top row is +z, and
columns run from +x towards +y, as in the Sph-Mip map; texel centres are at + 0.5.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

DIELECTRIC = 0.04  # reflectance of glTF's and USD's non-metals, straight on
SMOOTHEST = 0.1  # roughness of a mirror here: its lobe is about as wide as a texel
# Roughness and rows of the pictures that are blurred for it; between them one interpolates.
ROUGHNESSES = (SMOOTHEST, 0.2, 0.35, 0.6, 1.0)
_SHARP = 64  # rows from which pictures are halved before they are blurred
_SHARE = 1e-3  # of a lobe's peak: less is left out
_CHUNK = 512
_NODES, _SPREAD = 33, 64  # of the table of mirrored shares, and of its quadrature, along an edge


def texel_directions(height: int) -> F64:
    """(H, 2H, 3) unit directions of the texels' centres."""
    polar = (np.arange(height) + 0.5) / height * np.pi
    azimuth = (np.arange(2 * height) + 0.5) / height * np.pi
    theta, phi = np.meshgrid(polar, azimuth, indexing="ij")
    level = np.sin(theta)
    return np.stack([level * np.cos(phi), level * np.sin(phi), np.cos(theta)], -1)


def solid_angles(height: int) -> F64:
    """(H, 2H) the texels' solid angles in steradians; their sum is 4 pi."""
    edges = np.cos(np.arange(height + 1) / height * np.pi)
    return np.repeat((edges[:-1] - edges[1:])[:, None] * np.pi / height, 2 * height, axis=1)


def lookups(directions: F32 | F64, height: int) -> tuple[Ints, F32]:
    """Flat texels (N, 4) and weights (N, 4) of bilinear lookups; the azimuth wraps.

    Args:
        directions: (N, 3) unit.
    """
    x, y, z = np.asarray(directions, np.float64).T
    width = 2 * height
    column = np.arctan2(y, x) / (2 * np.pi) * width - 0.5
    row = np.arccos(np.clip(z, -1, 1)) / np.pi * height - 0.5
    left, upper = np.floor(column), np.floor(row)
    across, down = column - left, row - upper
    above, below = (np.clip(upper + i, 0, height - 1).astype(np.int64) * width for i in (0, 1))
    first, second = ((left + i).astype(np.int64) % width for i in (0, 1))
    index = np.stack([above + first, above + second, below + first, below + second], 1)
    weights = [(1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across]
    return index, np.stack(weights, 1).astype(np.float32)


def looked_up(picture: F32, directions: F32 | F64) -> F32:
    """(..., 3) bilinear values of a lat-long picture in unit directions (..., 3)."""
    index, weights = lookups(directions.reshape(-1, 3), len(picture))
    found = np.einsum("nk,nkc->nc", weights, picture.reshape(-1, 3)[index])
    return np.asarray(found.reshape(directions.shape), np.float32)


def ggx_lobe(cosine: F64, roughness: float) -> F64:
    """Weight of light at an angle to the mirrored ray, for an eye along the normal, unnormalised.

    Karis 2013, "Real Shading in Unreal Engine 4": n = v = r, so that the half vector is at half
    the angle; GGX with alpha = roughness^2, times the cosine at the surface.
    """
    alpha2 = roughness**4
    half2 = (1 + cosine) / 2
    lobe = alpha2 / (half2 * (alpha2 - 1) + 1) ** 2 * np.maximum(cosine, 0)
    return np.asarray(lobe, np.float64)


def cosine_lobe(cosine: F64, _: float = 1.0) -> F64:
    """Weight of light at an angle to the normal of a matte surface, unnormalised."""
    return np.asarray(np.maximum(cosine, 0), np.float64)


def reflected_share(f0: F32, roughness: F32, cosine: F32) -> F32:
    """(N, C) share of the light that is mirrored, as `reflection_line` has it; numpy arrays.

    Args:
        f0: reflectance straight on; roughness, cosine: (N, 1).
    """
    scale, offset = reflection_line(roughness, cosine)
    return np.asarray(f0 * scale + offset, np.float32)


def passed_share(roughness: Any, cosine: Any) -> Any:
    """Share of what a non-metal scatters that passes the layer that mirrors.

    glTF 2.0, appendix B ("fresnel_mix"): what is mirrored is not scattered. Numpy arrays or torch
    tensors.
    """
    scale, offset = reflection_line(roughness, cosine)
    return 1 - (DIELECTRIC * scale + offset)


def reflection_line(roughness: Any, cosine: Any) -> tuple[Any, Any]:
    """Factor and offset that turn f0 into the mirrored share of even light from all sides.

    Karis 2013, the split sum's second half, from a table; GGX with the masking and shadowing of
    Heitz 2014 for both directions together, Schlick's Fresnel term, one bounce. Numpy arrays or
    torch tensors of equal or broadcastable shapes; a gradient flows through both.

    Args:
        roughness: in [0, 1]; cosine: in (0, 1], between the normal and the way to the eye.
    """
    row, down = _place(roughness + 0 * cosine)
    column, along = _place(cosine + 0 * roughness)
    like = getattr(along, "new_tensor", np.asarray)
    found = []
    for table in _shares():
        corners = [[like(table[row + i, column + j]) for j in (0, 1)] for i in (0, 1)]
        low, high = (left + along * (right - left) for left, right in corners)
        found.append(low + down * (high - low))
    return found[0], found[1]


def _place(numbers: Any) -> tuple[Ints, Any]:
    """The node below, in a table of _NODES over [0, 1], and how far above it, in cells."""
    plain = np.asarray(numbers.detach() if hasattr(numbers, "detach") else numbers, np.float64)
    node = np.clip(np.floor(plain * (_NODES - 1)), 0, _NODES - 2).astype(np.int64)
    like = getattr(numbers, "new_tensor", np.asarray)
    return node, numbers * (_NODES - 1) - like(node.astype(np.float32))


@lru_cache(maxsize=1)
def _shares() -> F32:
    """(2, _NODES, _NODES) factor and offset for roughness and cosine in [0, 1].

    Half vectors have the density D (n.h) of GGX. Factor and offset are the means of w (1 - F) and
    of w F, with w = 4 V (n.l) (v.h) / (n.h), V as in glTF 2.0, F = (1 - v.h)^5.
    """
    found = np.empty((2, _NODES, _NODES), np.float32)
    steps = np.linspace(0, 1, _NODES)
    cosine = np.maximum(steps, 1e-3)[:, None, None]
    part = (np.arange(_SPREAD) + 0.5) / _SPREAD
    around = np.cos(np.pi * part)[None, None]
    for row, roughness in enumerate(steps):
        alpha2 = max(roughness, 0.01) ** 4
        n_h = np.sqrt((1 - part) / (1 + (alpha2 - 1) * part))[None, :, None]
        slope = np.sqrt((1 - n_h**2) * (1 - cosine**2))
        v_h = n_h * cosine + slope * around
        n_l = 2 * v_h * n_h - cosine
        lit = (n_l > 0) & (v_h > 0)
        n_l, v_h = np.where(lit, n_l, 1), np.where(lit, v_h, 0)
        masked = n_l * np.sqrt(cosine**2 * (1 - alpha2) + alpha2)
        masked = masked + cosine * np.sqrt(n_l**2 * (1 - alpha2) + alpha2)
        share = np.where(lit, 2 * n_l * v_h / (masked * n_h), 0)
        fresnel = (1 - v_h) ** 5
        found[0, row] = (share * (1 - fresnel)).mean((1, 2))
        found[1, row] = (share * fresnel).mean((1, 2))
    return found


@dataclass(frozen=True)
class Blur:
    """Turns a picture of radiance into one for every level of ROUGHNESSES, and one of irradiance.

    Args:
        height: rows of the picture.
        heights: rows of the blurred ones, as in ROUGHNESSES; the last is of matte surfaces.
        operators: sparse matrices that are applied to the picture with `heights[1]` rows, and to
            half of that.
    """

    height: int
    heights: tuple[int, ...]
    operators: tuple[Any, ...]

    def __call__(self, picture: F32) -> list[F32]:
        """(height * 2 height, 3) to [(h * 2h, 3)] for every h of `heights`."""
        middle = reduced(picture, self.height, self.heights[1])
        half = reduced(middle, self.heights[1], self.heights[1] // 2)
        return [picture, self.operators[0] @ middle, *(op @ half for op in self.operators[1:])]

    def transposed(self, gradients: list[F32]) -> F32:
        """The gradient of the picture from those of its blurred ones."""
        half = sum(op.T @ g for op, g in zip(self.operators[1:], gradients[2:], strict=True))
        rows = self.heights[1]
        middle = self.operators[0].T @ gradients[1] + _shared_out(half, rows // 2, rows)
        return np.asarray(gradients[0] + _shared_out(middle, rows, self.height), np.float32)


@lru_cache(maxsize=2)
def blur(height: int) -> Blur:
    """The blur of pictures with that many rows, a multiple of 4."""
    middle = height
    while middle >= 2 * _SHARP and middle % 8 == 0:
        middle //= 2
    half = middle // 2
    heights = (height, middle, half, half // 2, half // 2, half // 2)
    operators = [_operator(ggx_lobe, ROUGHNESSES[1], middle, middle)]
    for roughness, rows in zip(ROUGHNESSES[2:], heights[2:], strict=False):
        operators.append(_operator(ggx_lobe, roughness, half, rows))
    operators.append(_operator(cosine_lobe, 1.0, half, heights[-1]))
    return Blur(height, heights, tuple(operators))


def reduced(picture: F32, height: int, rows: int) -> F32:
    """(rows * 2 rows, 3) a flat picture of fewer rows, a divisor of `height`, by averaging."""
    step = height // rows
    if step == 1:
        return picture
    parts = picture.reshape(rows, step, 2 * rows, step, 3)
    return np.ascontiguousarray(parts.mean((1, 3)).reshape(-1, 3))


def _shared_out(gradient: Any, rows: int, height: int) -> F32:
    """The gradient of a picture from that of its `reduced` one."""
    step = height // rows
    coarse = np.asarray(gradient, np.float32).reshape(rows, 2 * rows, 3)
    fine = np.repeat(np.repeat(coarse, step, axis=0), step, axis=1).reshape(-1, 3)
    return np.asarray(fine / np.float32(step * step), np.float32)


def level_weights(roughness: Any) -> list[Any]:
    """How much each of ROUGHNESSES counts at a roughness in their range; they add up to 1.

    Numpy arrays or torch tensors.
    """
    weights = []
    for i, here in enumerate(ROUGHNESSES):
        weight = 0 * roughness + 1
        if i:
            weight = weight * ((roughness - ROUGHNESSES[i - 1]) / (here - ROUGHNESSES[i - 1]))
        if i + 1 < len(ROUGHNESSES):
            falling = (ROUGHNESSES[i + 1] - roughness) / (ROUGHNESSES[i + 1] - here)
            weight = (weight + falling - abs(weight - falling)) / 2 if i else falling
        weights.append(weight.clip(0, 1))
    return weights


class Light(Protocol):
    """Light from far away that can be looked up by direction."""

    def mirrored(self, directions: F32, roughness: F32) -> F32:
        """(N, 3) radiance for mirrored rays (N, 3) and roughness (N,)."""
        ...


class Environment:
    """Light from far away, looked up blurred.

    Args:
        radiance: (H, 2H, 3) linear.
    """

    def __init__(self, radiance: F32) -> None:
        self.blur = blur(len(radiance))
        self.levels = self.blur(np.asarray(radiance, np.float32).reshape(-1, 3))

    def mirrored(self, directions: F32, roughness: F32) -> F32:
        """(N, 3) radiance of the split sum's first half for mirrored rays (N, 3)."""
        total = np.zeros((len(directions), 3), np.float32)
        clipped = np.clip(roughness, SMOOTHEST, 1)
        for i, weight in enumerate(level_weights(clipped)):
            there = np.flatnonzero(weight > 0)
            total[there] += weight[there, None] * self._look(directions[there], i)
        return total

    def scattered(self, normals: F32) -> F32:
        """(N, 3) radiance of a white matte surface with these normals (N, 3), in the open."""
        return self._look(normals, len(ROUGHNESSES))

    def _look(self, directions: F32, level: int) -> F32:
        index, weights = lookups(directions, self.blur.heights[level])
        found = np.einsum("nk,nkc->nc", weights, self.levels[level][index])
        return np.asarray(found, np.float32)


@dataclass(frozen=True)
class Turned:
    """Light in a frame that is turned against the world.

    Args:
        light: in its own frame; turn: (3, 3) rotation of world directions into that.
    """

    light: Light
    turn: F64

    def mirrored(self, directions: F32, roughness: F32) -> F32:
        """(N, 3) radiance for mirrored world rays (N, 3)."""
        turned = np.asarray(directions @ self.turn.T, np.float32)
        return self.light.mirrored(turned, roughness)


def _operator(lobe: Any, roughness: float, source: int, target: int) -> Any:
    """Sparse (2 target^2, 2 source^2) matrix that averages under a lobe around each direction."""
    from scipy.sparse import csr_array, vstack

    directions = texel_directions(source).reshape(-1, 3)
    size = solid_angles(source).reshape(-1)
    around = texel_directions(target).reshape(-1, 3)
    rows = []
    for start in range(0, len(around), _CHUNK):
        weights = lobe(around[start : start + _CHUNK] @ directions.T, roughness)
        weights[weights < _SHARE * weights.max(1, keepdims=True)] = 0
        weights *= size
        weights /= weights.sum(1, keepdims=True)
        rows.append(csr_array(weights.astype(np.float32)))
    return vstack(rows, format="csr")
