"""Base colours that look like the photos once the asset is drawn in its own light.

What is baked from the field is as blurred as the field's pictures, and shading that the light found
does not explain is left in it or missing. Here the renderer that scores the asset says what every
pixel of the training photos shows as a line in the base colours of the texels under it,

    radiance = received * sum of (weight * base) + mirrored

and a correction of the base colours is solved for by damped Gauss-Newton steps, each by some steps
of conjugate gradients, sRGB differences, robust. What mirrors little counts most, and metals do not
count: so reflections do not end up in the colours. Both sides of a cut are corrected
alike.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import linear_from_srgb, srgb_from_linear, srgb_slope
from refdgs_pipe.ray_casting import Hits, at_hits
from refdgs_pipe.relight import LOBE, Relit, in_its_light, offsets, rays_of
from refdgs_pipe.texture.texels import cuts, rasterize

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]

_PER_TEXEL = 2.0  # pixels for each texel of the texture at most: bounds the cost
_NEEDED = 2.0  # pixels for each covered texel that is solved for
_SIDE = 2  # rays along a pixel's side
_LEAST_COSINE = 0.2
_WHITE = 0.99  # sRGB: brighter pixels are clipped and tell nothing
_ROUNDS = 3
_STEPS = 8  # of conjugate gradients in a round
_ROBUST = 0.1  # sRGB: pixels that differ by more count less
_DAMPING = 0.01  # of the correction, in pixels that see the texel under white light
_ALIKE = 0.5  # weight of two places being corrected alike, in such pixels


@dataclass(frozen=True)
class Pixels:
    """N pixels of photos, and what the asset shows there.

    Args:
        uv: (N, rays, 2) texture coordinates under the pixel.
        received: (N, 3) linear radiance of a white matte surface, times its matte share.
        mirrored: (N, 3) linear radiance that is mirrored to the eye.
        matte: (N,) how much the pixel tells of the base colour, 0 to 1.
        photo: (N, 3) sRGB.
    """

    uv: F32
    received: F32
    mirrored: F32
    matte: F32
    photo: F32


class Refiner:
    """Takes one photo after another, and then corrects the base colours.

    Args:
        relit: the asset's renderer in its light; textured: the asset.
        near: rays of one pixel whose depths differ by more meet two parts, world units.
        photos: how many there will be.
    """

    def __init__(self, textured: TexturedMesh, relit: Relit, *, near: float, photos: int) -> None:
        self.textured, self.near = textured, near
        self._relit = relit
        self._most = int(_PER_TEXEL * textured.size**2 / max(1, photos))
        self._parts: list[Pixels] = []

    def add(self, photo: Photo) -> int:
        """Take the pixels that show nothing but the asset; gives how many."""
        found, uv, centre, rays = self._under(photo)
        if not len(found):
            return 0
        half = range(len(self._parts) % 2, LOBE, 2)  # many photos see a texel: each takes half
        seen = self._relit.under(photo.camera).surface(centre, -rays, half)
        matte = seen.here.base * (1 - seen.here.metallic) * seen.received
        share = matte.mean(1) / np.maximum((matte + seen.mirrored).mean(1), 1e-4)
        trust = (1 - seen.here.metallic[:, 0]) ** 2 * share * (seen.cosine > _LEAST_COSINE)
        good = np.flatnonzero(trust > 1e-3)
        self._parts.append(
            Pixels(
                uv[good],
                ((1 - seen.here.metallic) * seen.received)[good],
                seen.mirrored[good],
                trust[good].astype(np.float32),
                photo.rgb.reshape(-1, 3)[found[good]],
            )
        )
        return len(good)

    def _under(self, photo: Photo) -> tuple[Ints, F32, Hits, F32]:
        """Pixels of one surface; texture coordinates under them; what their centres meet, how."""
        camera, mesh = photo.camera, self._relit.mesh
        eye = camera.center.astype(np.float32)
        pixels = _usable(photo)
        rays = rays_of(camera, pixels)
        hits = self._relit.solid.first(eye, rays)
        chance = np.random.default_rng(len(self._parts))
        chosen = np.sort(chance.permutation(len(hits.rays))[: self._most])
        hits = hits.chosen(chosen)
        pixels, rays = pixels[hits.rays], rays[hits.rays]
        depth, whole = hits.distance, np.ones(len(pixels), bool)
        uv = np.zeros((len(pixels), _SIDE * _SIDE, 2), np.float32)
        for i, offset in enumerate(offsets(_SIDE)):
            beside = self._relit.solid.first(eye, rays_of(camera, pixels, offset))
            apart = np.full(len(pixels), np.inf, np.float32)
            apart[beside.rays] = np.abs(beside.distance - depth[beside.rays])
            whole &= apart < self.near
            uv[beside.rays, i] = at_hits(mesh.uv, mesh.faces, beside.face, beside.weights)
        kept = np.flatnonzero(whole)
        return pixels[kept], uv[kept], hits.chosen(kept), rays[kept]

    def refined(self) -> TexturedMesh:
        """The asset with corrected base colours; as it was if no photo told anything."""
        if not self._parts:
            return self.textured
        fields = Pixels.__dataclass_fields__
        pixels = Pixels(**{n: np.concatenate([getattr(p, n) for p in self._parts]) for n in fields})
        size = self.textured.size
        texels = rasterize(self.textured.mesh, size)
        base = linear_from_srgb(np.float32(1 / 65535) * self.textured.base_color.astype(np.float32))
        side = _side(size, len(texels.index), len(pixels.photo))
        change = correction(pixels, _sized(base, side), _alike(self.textured.mesh, side))
        matte = 1 - self.textured.metallic.astype(np.float32)[..., None] / np.float32(65535)
        coded = srgb_from_linear(base + matte * _sized(change, size)).reshape(-1, 3)[texels.index]
        painted = texels.picture(np.round(coded * 65535).astype(np.uint16))
        return replace(self.textured, base_color=painted)


def refined(
    textured: TexturedMesh,
    looks: Appearance,
    photos: Iterable[Photo],
    *,
    near: float,
    count: int,
) -> TexturedMesh:
    """The asset with base colours that look as the photos do in its light.

    Args:
        looks: its light.
        near: rays of one pixel whose depths differ by more meet two parts, world units.
        count: of the photos.
    """
    refiner = Refiner(textured, in_its_light(textured, looks), near=near, photos=count)
    for photo in photos:
        refiner.add(photo)
    return refiner.refined()


def _usable(photo: Photo) -> Ints:
    """The pixels of the object alone that are not clipped."""
    return np.flatnonzero(photo.alone().max(-1) < _WHITE)


def _side(size: int, covered: int, count: int) -> int:
    """The side of the largest texture, at most `size`, whose texels so many pixels tell of.

    Args:
        covered: texels of the full size that charts cover.
    """
    side = size
    while side > 64 and count < _NEEDED * covered * (side / size) ** 2:
        side //= 2
    return side


def _sized(picture: F32, side: int) -> F32:
    shape = (side, side)
    how = cv2.INTER_AREA if side < len(picture) else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, shape, interpolation=how), np.float32)


def correction(pixels: Pixels, base: F32, alike: tuple[F32, F32] | None = None) -> F32:
    """(S, S, 3) linear, what to add to the base colours (S, S, 3).

    Args:
        alike: texture coordinates (K, 2) and (K, 2) of places that are corrected alike.
    """
    side = len(base)
    under = _lookups(pixels.uv, side)
    there = under @ base.reshape(-1, 3)
    rows = _stacked(under, alike, side)
    back = rows.T.tocsr()
    change = np.zeros((side * side, 3), np.float32)
    weight = np.full((rows.shape[0], 3), _ALIKE, np.float32)
    for _ in range(_ROUNDS):
        shown = rows @ change
        linear = pixels.received * np.maximum(there + shown[: len(there)], 0) + pixels.mirrored
        apart = pixels.photo - srgb_from_linear(linear)
        trust = (pixels.matte / (1 + (apart**2).sum(1) / _ROBUST**2))[:, None]
        slope = pixels.received * srgb_slope(linear)
        weight[: len(there)] = trust * slope * slope
        wanted = -weight * shown
        wanted[: len(there)] = trust * slope * apart
        change += _solved(rows, back, weight, back @ wanted - np.float32(_DAMPING) * change)
    return np.asarray(change.reshape(side, side, 3), np.float32)


def _alike(mesh: UvMesh, side: int) -> tuple[F32, F32]:
    """Texture coordinates of places that are one: beside a chart and in it, across a cut."""
    one, other = zip(cuts(mesh), rasterize(mesh, side).beside(), strict=True)
    return np.concatenate(one), np.concatenate(other)


def _stacked(under: csr_array, alike: tuple[F32, F32] | None, side: int) -> csr_array:
    """The lookups of the pixels, and the differences of places that are corrected alike."""
    if alike is None:
        return under
    one, other = (_lookups(uv[:, None], side) for uv in alike)
    return csr_array(vstack([under, one - other], format="csr"))


def _solved(rows: csr_array, back: csr_array, weight: F32, wanted: F32) -> F32:
    """(T, 3) some way to what solves (rows^T weight rows + damping) x = wanted, each channel alone.

    Conjugate gradients, preconditioned by how much each texel is seen.
    """
    damping = np.float32(_DAMPING)
    scale = 1 / (abs(back) @ weight + damping)
    found, left = np.zeros_like(wanted), wanted
    aim = scale * left
    toward, size = aim, (left * aim).sum(0)
    for _ in range(_STEPS):
        moved = back @ (weight * (rows @ toward)) + damping * toward
        pace = size / np.maximum((toward * moved).sum(0), np.float32(1e-20))
        found, left = found + pace * toward, left - pace * moved
        aim = scale * left
        before, size = size, (left * aim).sum(0)
        toward = aim + size / np.maximum(before, np.float32(1e-20)) * toward
    return np.asarray(found, np.float32)


def _lookups(uv: F32, side: int) -> csr_array:
    """Sparse (N, side^2): the mean of bilinear lookups at texture coordinates (N, rays, 2)."""
    x, y = np.moveaxis(np.clip(uv * side - 0.5, 0, side - 1.001), -1, 0)
    left, top = x.astype(np.int32), y.astype(np.int32)
    across, down = (x - left).astype(np.float32), (y - top).astype(np.float32)
    first = top * np.int32(side) + left
    columns = np.stack([first, first + 1, first + side, first + side + 1], -1)
    weights = np.stack(
        [
            (1 - down) * (1 - across),
            (1 - down) * across,
            down * (1 - across),
            down * across,
        ],
        -1,
    ) / np.float32(uv.shape[1])
    count, each = len(uv), 4 * uv.shape[1]
    start = np.arange(0, each * count + 1, each)
    return csr_array((weights.reshape(-1), columns.reshape(-1), start), shape=(count, side * side))
