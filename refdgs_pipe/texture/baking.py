"""What each texel looks like, gathered from the maps of all views that see it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.errors import MeshError
from refdgs_pipe.geometry import without_jumps
from refdgs_pipe.texture.points import MOVED, SurfacePoints, bilinear

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_CHANNELS = 6  # diffuse 3, normal 3
_MIN_ALPHA = 0.5
_MIN_COSINE = 0.2
# Where a part of the mesh was moved off the field, as a dent or a bulge that was made flat, the
# field's colours count where nothing nearer does; its normals do not.
_MOVED_WEIGHT = 1e-4  # of the usual weight
# Where the views' normals lie further apart than this (3 degrees), the mesh's own count more.
# Exact maps: 0.4 degrees off the truth, the mesh 1.6. A field of 1500 steps: maps
# 12.0, mesh 11.0, this mixture 11.4.
_NORMAL_SPREAD = 0.05
# What looking up between pixels, and drawing the texture into pixels again, blur: standard
# deviation in pixels (1/6 and 1/12 are their mean squares).
_LOST = 0.5
_CHUNK = 1 << 18


@dataclass(frozen=True)
class Surface:
    """What was gathered for N points of a surface.

    Args:
        diffuse: (N, 3) linear; normal: (N, 3) unit, world.
        seen: (N,) whether any view did.
    """

    diffuse: F32
    normal: F32
    seen: Bools


class Gather:
    """Collects samples of surface points, one view after another; memory does not grow with views.

    Each point keeps its `keep` best samples, so that outliers can be told from the rest.

    Args:
        points, normals: (N, 3) float32, world.
        tolerance: how far a point may lie from the depth map that shows it, world units. Where
            no map is so near, one that lies up to `MOVED` times as far off tells the colour.
    """

    def __init__(self, points: F32, normals: F32, *, tolerance: float, keep: int = 6) -> None:
        self._points, self._tolerance = SurfacePoints(points, normals), tolerance
        count = len(points)
        self._weights = np.zeros((count, keep), np.float32)
        self._samples = np.zeros((count, keep, _CHANNELS), np.float16)
        self._seen, self._near = np.zeros((2, count), bool)

    def add(self, view: SurfaceMap) -> int:
        """Take what one view shows; gives how many points it sees."""
        rows, pixels, weights, near = self._visible(view)
        if not len(rows):
            return 0
        values = np.concatenate([_sharpened(view.diffuse), view.normal], -1)
        samples = bilinear(values, pixels)
        self._seen[rows] = True
        self._near[rows[near]] = True
        worst = self._weights[rows].argmin(1)
        better = weights > self._weights[rows, worst]
        rows, worst = rows[better], worst[better]
        self._weights[rows, worst] = weights[better]
        self._samples[rows, worst] = np.minimum(samples[better], 60000.0)
        return len(weights)

    def surface(self) -> Surface:
        """Combine the samples. Points that no view saw take over from the nearest that were seen.

        Raises:
            MeshError: no view saw any point.
        """
        points, normals = self._points.points, self._points.normals
        count = len(points)
        seen = self._seen
        if not seen.any():
            raise MeshError(
                "no view shows any part of the mesh: the mesh and the cameras do not belong "
                "together. Run extract again, or drop the adopted mesh"
            )
        values, spread = np.zeros((count, _CHANNELS), np.float32), np.zeros((count, 1), np.float32)
        for start in range(0, count, _CHUNK):
            part = slice(start, start + _CHUNK)
            values[part], spread[part] = _combined(self._samples[part], self._weights[part])
        if not seen.all():
            values[~seen, :3] = _from_nearest(points, values[:, :3], seen)
        doubt = (spread / _NORMAL_SPREAD) ** 2
        normal = np.where(self._near[:, None], values[:, 3:] + doubt * normals, normals)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        return Surface(
            values[:, :3],
            np.asarray(normal, np.float32),
            seen,
        )

    def _visible(self, view: SurfaceMap) -> tuple[Ints, F32, F32, Bools]:
        """Rows of the points that a view sees, their pixel coordinates, how well, and how near."""
        solid = without_jumps(view.depth, view.normal, view.camera, self._tolerance)
        solid &= view.alpha >= _MIN_ALPHA
        found = self._points.shown(
            view.camera,
            np.stack([view.depth, solid.astype(np.float32), view.alpha], -1),
            tolerance=self._tolerance,
            least_cosine=_MIN_COSINE,
            moved=MOVED * self._tolerance,
        )
        weights = found.cosine**2 * found.layers[:, 2] * np.where(found.near, 1, _MOVED_WEIGHT)
        return found.rows, found.pixels, weights.astype(np.float32), found.near


def _sharpened(picture: F32) -> F32:
    """The picture before a blur of `_LOST` pixels, to first order (van Cittert's first step)."""
    import cv2

    soft = np.asarray(cv2.GaussianBlur(picture, (0, 0), _LOST), np.float32)
    return np.asarray(np.maximum(2 * picture - soft, 0), np.float32)


def _combined(samples: NDArray[np.float16], weights: F32) -> tuple[F32, F32]:
    """(N, 6) robust mean of samples (N, K, 6); (N, 1) how far apart the normals lie.

    Iteratively reweighted (Cauchy): a sample that disagrees with the others loses its weight.
    """
    values = samples.astype(np.float32)
    out = np.zeros((len(values), _CHANNELS), np.float32)
    for channels, least in ((slice(0, 3), 0.02), (slice(3, 6), 0.03)):
        part: F32 = values[..., channels]
        trust: F32 = weights
        mean, apart = _mean(part, weights)
        for _ in range(3):
            scale = np.maximum(_mean(apart[..., None], trust)[0], least)
            trust = (weights / (1 + (apart / scale) ** 2)).astype(np.float32)
            mean, apart = _mean(part, trust)
        out[:, channels] = mean
    return out, _mean(apart[..., None], weights)[0]


def _mean(values: F32, weights: F32) -> tuple[F32, F32]:
    """Weighted mean (N, C) of (N, K, C), and the distance (N, K) of each sample to it."""
    total = np.maximum(weights.sum(1), 1e-9)
    mean = np.einsum("nk,nkc->nc", weights, values) / total[:, None]
    apart = np.linalg.norm(values - mean[:, None], axis=2)
    return mean.astype(np.float32), apart.astype(np.float32)


def _from_nearest(points: F32, values: F32, seen: Bools) -> F32:
    """Values for the unseen points: the mean of the four nearest seen ones, nearer counts more."""
    from scipy.spatial import cKDTree

    sources = np.flatnonzero(seen)
    sources = sources[:: max(1, len(sources) // 300_000)]
    distance, nearest = cKDTree(points[sources]).query(points[~seen], k=min(4, len(sources)))
    distance, nearest = distance.reshape(len(distance), -1), nearest.reshape(len(nearest), -1)
    weights = 1 / np.maximum(distance, 1e-9)
    weights /= weights.sum(1, keepdims=True)
    return np.asarray(np.einsum("nk,nkc->nc", weights, values[sources][nearest]), np.float32)
