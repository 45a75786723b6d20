"""Fine detail of base colours, taken from the photos at their full size.

A least-squares solution over all photos (`refining`) is as blurred as photos and mesh disagree. So
fine detail comes from the photo that shows a texel best, and from the second best as well where
both show it about equally well. Photos are aligned with the asset first. Changes over some more
pixels are the mean of all photos, and slow ones stay those of the solution (frequency bands, after
Burt and Adelson 1983).

A single photo also shows reflections and noise. So detail counts only as far as the other photos
show it too: the regression coefficient of their mean detail on the best photo's, over a few texels.
Print is on the surface, and all photos agree on it. A reflection moves with the camera. But black
gloss shows mostly reflections, and in all photos they end at its edges. So detail also counts only
as far as the matte colour is most of what photos show.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import fractions, linear_from_srgb, srgb_from_linear
from refdgs_pipe.ray_casting import Solid
from refdgs_pipe.texture.charts import signed_areas
from refdgs_pipe.texture.material import nearest
from refdgs_pipe.texture.photo_detail import Comparison, PhotoDetail
from refdgs_pipe.texture.points import SurfacePoints, bilinear
from refdgs_pipe.texture.texels import rasterize
from refdgs_pipe.texture.view_variation import smooth_step
from refdgs_pipe.vectors import unit

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]

_PASSES = 2  # over the photos: each is aligned with what the last pass found
_LEAST_COSINE = 0.25  # to the eye
_BORDER = 16.0  # power of a photo's worth, by which the two best are mixed
# Texels or pixels, whichever are larger (sigma): photos may be misplaced by that much and still
# agree; and over so many they are compared
_SOFT, _AROUND = 1.5, 8.0
_DISAGREE, _AGREE = 0.1, 0.4  # coefficient: from nothing kept to everything kept
_MIRRORS, _MATTE = 0.3, 0.7  # matte share of what photos show: the same
_ROUNDS = 20  # of smoothing normals over neighbours
_CHUNK = 1 << 18


class Detail:
    """Takes one photo after another, then adds their detail to the base colours.

    Args:
        textured: the asset, with base colours that are right but for fine detail.
        received: (V, 3) linear radiance of a white matte surface at the mesh's vertices.
        near: how far the depth of a texel may differ from that of its pixel, world units.
        threads: that work; the result does not depend on it.
        aligned_with: the same with the base colours that photos are aligned with; None: `textured`.
    """

    def __init__(
        self,
        textured: TexturedMesh,
        received: F32,
        *,
        near: float,
        threads: int = 1,
        aligned_with: TexturedMesh | None = None,
    ) -> None:
        self.textured, self.near, self.threads = textured, near, max(1, threads)
        mesh = textured.mesh
        solid = Solid(mesh.vertices, mesh.faces)
        self._compared = Comparison(solid, received, textured, aligned_with or textured, near)
        self._texels = rasterize(mesh, textured.size)
        self._points = SurfacePoints(
            self._texels.interpolate(mesh, mesh.vertices),
            unit(self._texels.interpolate(mesh, _smooth_normals(mesh))),
        )
        count = len(self._texels.index)
        self._worth = np.zeros((count, 2), np.float32)  # of the best and of the second best photo
        self._best = np.zeros((count, 2, 3), np.float16)
        self._sum = np.zeros((count, 3), np.float32)
        self._broad = np.zeros((count, 3), np.float32)
        self._slow = np.zeros((count, 2), np.float32)  # sums: the asset's, the photos'
        self._weight = np.zeros(count, np.float32)
        self._pixel = 1.0  # texels

    def add(self, photo: Photo) -> int:
        """Take what a photo shows; gives how many texels it shows."""
        detail = self._compared.detail_of(photo)
        if detail is None:
            return 0
        self._pixel = max(
            self._pixel, texels_of_pixel(self.textured.mesh, self.textured.size, photo.camera)
        )
        starts = range(0, len(self._texels.index), _CHUNK)
        with ThreadPoolExecutor(self.threads) as pool:
            return sum(pool.map(lambda start: self._take(detail, start), starts))

    def _take(self, detail: PhotoDetail, start: int) -> int:
        """Take what a photo shows of the texels from `start` on.

        A photo is worth its resolution along the direction in which the surface is foreshortened,
        pixels for a world unit.
        """
        shown = self._points.shown(
            detail.camera,
            np.stack([detail.depth, detail.good], -1),
            tolerance=self.near,
            least_cosine=_LEAST_COSINE,
            part=slice(start, start + _CHUNK),
        )
        if not len(shown.rows):
            return 0
        rows = shown.rows + start
        worth = shown.cosine * np.float32(detail.camera.K[0, 0]) / shown.depth
        found = bilinear(detail.fine, shown.pixels)
        self._sum[rows] += worth[:, None] * found
        self._broad[rows] += worth[:, None] * bilinear(detail.broad, shown.pixels)
        self._slow[rows] += worth[:, None] * bilinear(detail.slow, shown.pixels)
        self._weight[rows] += worth
        first = worth > self._worth[rows, 0]
        second = ~first & (worth > self._worth[rows, 1])
        for kept in (self._best, self._worth):
            kept[rows[first], 1] = kept[rows[first], 0]
        for place, those in enumerate((first, second)):
            self._best[rows[those], place] = found[those]
            self._worth[rows[those], place] = worth[those]
        return len(rows)

    def added(self) -> TexturedMesh:
        """The asset with the detail that photos agree on."""
        texels = self._texels
        high = self._worth[:, :1]
        seen = high[:, 0] > 0
        mix = np.where(self._worth > 0, self._worth / np.maximum(high, 1e-9), 0) ** _BORDER
        mix /= np.maximum(mix.sum(1, keepdims=True), 1e-9)
        best = np.einsum("nk,nkc->nc", mix, self._best.astype(np.float32))
        left = self._weight - self._worth[:, 0]
        others = self._sum - self._worth[:, :1] * self._best[:, 0].astype(np.float32)
        others /= np.maximum(left, 1e-9)[:, None]
        several = seen & (left > 1e-6 * high[:, 0])
        kept = _agreed(
            self._picture(best.mean(1) * several),
            self._picture(others.mean(1) * several),
            self._picture(several.astype(np.float32)),
            self._pixel,
        ).reshape(-1)[texels.index]
        best += self._broad / np.maximum(self._weight, 1e-9)[:, None]
        own, shown = self._slow.T
        matte = np.asarray(own / np.maximum(shown, 1e-6), np.float32)
        kept *= several * smooth_step(matte, _MIRRORS, _MATTE)
        more = kept[:, None] * best
        coded = self.textured.base_color.reshape(-1, 3)[texels.index]
        some = np.flatnonzero(more.any(1))
        base = linear_from_srgb(fractions(coded[some])) + more[some]
        coded[some] = np.round(srgb_from_linear(base) * 65535).astype(np.uint16)
        return replace(self.textured, base_color=texels.picture(coded))

    def _picture(self, values: F32) -> F32:
        """(S, S) values of the texels; 0 between the charts."""
        size = self.textured.size
        flat = np.zeros(size * size, np.float32)
        flat[self._texels.index] = values
        return flat.reshape(size, size)


def detailed(
    textured: TexturedMesh,
    looks: Appearance,
    photos: Callable[[Iterable[Camera]], Iterable[Photo]],
    cameras: list[Camera],
    track: Callable[[list[Camera], str], Iterable[Camera]],
    *,
    size: int,
    near: float,
    threads: int = 1,
) -> TexturedMesh:
    """The asset with the fine detail that its photos agree on.

    Args:
        looks: the light that its vertices receive.
        photos: gives those of some cameras; each is asked for once in each of the passes.
        track: wraps the cameras and says what is done, to report progress.
        size: texels along a side of the result; smaller textures are enlarged.
        near: how far the depth of a texel may differ from that of its pixel, world units.
        threads: that work; the result does not depend on it.
    """
    mesh, whole = textured.mesh, enlarged(textured, size)
    received = looks.received[nearest(looks.points, mesh.vertices)]
    rounds = iter(track(cameras * _PASSES, "taking detail from photos"))

    def one_pass(like: TexturedMesh) -> TexturedMesh:
        detail = Detail(whole, received, near=near, threads=threads, aligned_with=like)
        for photo in photos(islice(rounds, len(cameras))):
            detail.add(photo)
        return detail.added()

    found = whole
    for _ in range(_PASSES):
        found = one_pass(found)
    return found


def enlarged(textured: TexturedMesh, size: int) -> TexturedMesh:
    """The same with textures of (size, size) texels, interpolated."""
    if size == textured.size:
        return textured

    def larger(texture: NDArray[np.uint16]) -> NDArray[np.uint16]:
        found = cv2.resize(texture, (size, size), interpolation=cv2.INTER_LINEAR)
        return np.asarray(found, np.uint16)

    return TexturedMesh(
        textured.mesh,
        textured.tangents,
        base_color=larger(textured.base_color),
        roughness=larger(textured.roughness),
        metallic=larger(textured.metallic),
        occlusion=larger(textured.occlusion),
        normal=larger(textured.normal),
        confidence=larger(textured.confidence),
    )


def _smooth_normals(mesh: UvMesh) -> F32:
    """(V, 3) normals, each the mean of those around it: the best photo must not change often."""
    _, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    same = same.reshape(-1)
    count = int(same.max()) + 1
    edges = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], -1).reshape(-1, 2)
    ends = same[np.concatenate([edges, edges[:, ::-1]])]
    beside = csr_array((np.ones(len(ends), np.float32), ends.T), shape=(count, count))
    normals = np.zeros((count, 3), np.float32)
    np.add.at(normals, same, mesh.normals)
    for _ in range(_ROUNDS):
        normals = unit(normals + beside @ normals)
    return np.asarray(normals[same], np.float32)


def texels_of_pixel(mesh: UvMesh, size: int, camera: Camera) -> float:
    """How many texels lie along the side of a camera's pixel, at the middle of the mesh.

    Args:
        size: texels along a side of the atlas.
    """
    flat = np.abs(signed_areas(mesh.uv[mesh.faces])).sum()
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    texel = np.sqrt(area / max(flat, 1e-12)) / size
    depth = camera.project(mesh.vertices.astype(np.float64))[1]
    pixel = float(np.median(depth)) / camera.K[0, 0]
    return float(pixel / max(texel, 1e-12))


def close_ups(
    mesh: UvMesh, load: Callable[..., Photo], size: int, ball: Ball, cameras: Iterable[Camera]
) -> Iterator[Photo]:
    """The part of each camera's photo that shows the object, as large as the atlas needs it.

    Args:
        load: gives a camera's photo, `scale` times as large.
        size: texels along a side of the atlas.
    """
    for camera in cameras:
        photo = load(camera, scale=scale_for(mesh, size, camera))
        yield photo.framed(ball.center, ball.radius)


def scale_for(mesh: UvMesh, size: int, camera: Camera) -> float:
    """The scale, at most 1, at which a pixel of the camera's photo is as large as a texel.

    Args:
        size: texels along a side of the atlas.
    """
    return float(np.clip(texels_of_pixel(mesh, size, camera), 0.05, 1.0))


def _agreed(best: F32, others: F32, known: F32, pixel: float) -> F32:
    """(S, S) 0 to 1: how much of the best photo's detail the others show too.

    Args:
        best, others: (S, S) their detail, 0 where nothing is known; known: (S, S) 1 where it is.
        pixel: texels along the side of a pixel, at least 1.
    """
    soft, around = _SOFT * pixel, _AROUND * pixel
    share = np.maximum(cv2.GaussianBlur(known, (0, 0), soft), 1e-3)
    one, other = (cv2.GaussianBlur(v, (0, 0), soft) / share * known for v in (best, others))
    both = cv2.GaussianBlur(one * other, (0, 0), around)
    own = cv2.GaussianBlur(one * one, (0, 0), around)
    coefficient = both / np.maximum(own, 1e-10)
    return smooth_step(np.asarray(coefficient, np.float32), _DISAGREE, _AGREE)
