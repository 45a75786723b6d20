"""What each texel looks like, gathered from the maps of all views that see it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.errors import MeshError
from refdgs_pipe.geometry import without_jumps

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]

_CHANNELS = 6  # diffuse 3, normal 3
_MIN_ALPHA = 0.5
_MIN_COSINE = 0.2
# Where the views' normals lie further apart than this (3 degrees), the mesh's own count more.
# Exact maps: 0.4 degrees off the truth, the mesh 1.6. A field of 1500 steps: maps
# 12.0, mesh 11.0, this mixture 11.4.
_NORMAL_SPREAD = 0.05
# What looking up between pixels, and drawing the texture into pixels again, blur: standard
# deviation in pixels (1/6 and 1/12 are their mean squares).
_LOST = 0.5
_CHUNK = 1 << 18
_ROW = 1024  # cv2.remap refuses more than 32767 rows or columns


@dataclass(frozen=True)
class Surface:
    """What was gathered for N points of a surface.

    Args:
        diffuse: (N, 3) linear; normal: (N, 3) unit, world.
        confidence: (N,) 0 where no view saw the point, towards 1 for many that agree.
        seen: (N,) whether any view did.
    """

    diffuse: F32
    normal: F32
    confidence: F32
    seen: NDArray[np.bool_]


class Gather:
    """Collects samples of surface points, one view after another; memory does not grow with views.

    Each point keeps its `keep` best samples, so that outliers can be told from the rest.

    Args:
        points, normals: (N, 3) float32, world.
        tolerance: how far a point may lie from the depth map that shows it, world units.
    """

    def __init__(self, points: F32, normals: F32, *, tolerance: float, keep: int = 6) -> None:
        self.points, self.normals, self.tolerance = points, normals, tolerance
        count = len(points)
        self._offset = np.einsum("nc,nc->n", points, normals)
        self._weights = np.zeros((count, keep), np.float32)
        self._samples = np.zeros((count, keep, _CHANNELS), np.float16)
        self._total = np.zeros(count, np.float32)

    def add(self, view: SurfaceMap) -> int:
        """Take what one view shows; gives how many points it sees."""
        rows, pixels, weights = self._visible(view)
        if not len(rows):
            return 0
        values = np.concatenate([_sharpened(view.diffuse), view.normal], -1)
        samples = _bilinear(values, pixels)
        self._total[rows] += weights
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
        count = len(self.points)
        seen = self._total > 0
        if not seen.any():
            raise MeshError(
                "no view shows any part of the mesh: the mesh and the cameras do not belong "
                "together. Run extract again, or drop the adopted mesh"
            )
        values, spread = np.zeros((count, _CHANNELS), np.float32), np.zeros((count, 2), np.float32)
        for start in range(0, count, _CHUNK):
            part = slice(start, start + _CHUNK)
            values[part], spread[part] = _combined(self._samples[part], self._weights[part])
        if not seen.all():
            values[~seen, :3] = _from_nearest(self.points, values[:, :3], seen)
        doubt = (spread[:, 1:] / _NORMAL_SPREAD) ** 2
        normal = np.where(seen[:, None], values[:, 3:] + doubt * self.normals, self.normals)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        confidence = (1 - np.exp(-self._total / 0.7)) / (1 + (spread[:, 0] / 0.1) ** 2)
        return Surface(
            values[:, :3],
            np.asarray(normal, np.float32),
            np.asarray(confidence, np.float32),
            seen,
        )

    def _visible(self, view: SurfaceMap) -> tuple[Ints, F32, F32]:
        """Rows of the points that a view sees, their pixel coordinates, and how well it does."""
        camera = view.camera
        R, t = (camera.cam_from_world[:3, i].astype(np.float32) for i in (slice(3), 3))
        # Whole rows of three are slow to reduce; half of the points go by what one product tells.
        height = self.normals @ camera.center.astype(np.float32) - self._offset
        rows = np.flatnonzero((height > 0) & (self.points @ R[2] + t[2] > 0))
        x, y, z = R @ self.points[rows].T + t[:, None]
        cosine = np.minimum(height[rows] / np.sqrt(x * x + y * y + z * z), 1)  # rounding
        K = camera.K.astype(np.float32)
        u, v = x / z * K[0, 0] + K[0, 2], y / z * K[1, 1] + K[1, 2]
        inside = (u > 0.5) & (v > 0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
        good = np.flatnonzero(inside & (cosine > _MIN_COSINE))
        rows, cosine, z = rows[good], cosine[good], z[good]
        pixels = np.stack([u[good], v[good]], 1)
        solid = without_jumps(view.depth, view.normal, camera, self.tolerance)
        solid &= view.alpha >= _MIN_ALPHA
        sampled = _bilinear(
            np.stack([view.depth, view.alpha, solid.astype(np.float32)], -1), pixels
        )
        slope = np.sqrt(1 / cosine**2 - 1)
        allowed = self.tolerance + slope * z / float(K[0, 0])
        good = (np.abs(sampled[:, 0] - z) < allowed) & (sampled[:, 2] > 0.999)
        weights = (cosine**2 * sampled[:, 1])[good]
        return rows[good], pixels[good], weights.astype(np.float32)


def _sharpened(picture: F32) -> F32:
    """The picture before a blur of `_LOST` pixels, to first order (van Cittert's first step)."""
    import cv2

    soft = np.asarray(cv2.GaussianBlur(picture, (0, 0), _LOST), np.float32)
    return np.asarray(np.maximum(2 * picture - soft, 0), np.float32)


def _bilinear(values: F32, pixels: F32) -> F32:
    """(N, C) values (H, W, C) at pixel coordinates (N, 2), centres at + 0.5."""
    import cv2

    count = len(pixels)
    if not count:
        return np.empty((0, values.shape[-1]), np.float32)
    padded = np.zeros((-(-count // _ROW) * _ROW, 2), np.float32)
    padded[:count] = pixels - 0.5
    x, y = (np.ascontiguousarray(padded[:, i].reshape(-1, _ROW)) for i in range(2))
    parts = []
    for start in range(0, values.shape[-1], 4):
        part = np.ascontiguousarray(values[..., start : start + 4], np.float32)
        found = cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        parts.append(np.asarray(found).reshape(len(padded), -1)[:count])
    return np.concatenate(parts, 1)


def _combined(samples: NDArray[np.float16], weights: F32) -> tuple[F32, F32]:
    """(N, 6) robust mean of samples (N, K, 7); (N, 2) how far apart colours and normals lie.

    Iteratively reweighted (Cauchy): a sample that disagrees with the others loses its weight.
    """
    values = samples.astype(np.float32)
    out = np.zeros((len(values), _CHANNELS), np.float32)
    spread = np.zeros((len(values), 2), np.float32)
    for channels, least in ((slice(0, 3), 0.02), (slice(3, 6), 0.03)):
        part: F32 = values[..., channels]
        trust: F32 = weights
        mean, apart = _mean(part, weights)
        for _ in range(3):
            scale = np.maximum(_mean(apart[..., None], trust)[0], least)
            trust = (weights / (1 + (apart / scale) ** 2)).astype(np.float32)
            mean, apart = _mean(part, trust)
        out[:, channels] = mean
        spread[:, channels.start // 3] = _mean(apart[..., None], weights)[0][:, 0]
    return out, spread


def _mean(values: F32, weights: F32) -> tuple[F32, F32]:
    """Weighted mean (N, C) of (N, K, C), and the distance (N, K) of each sample to it."""
    total = np.maximum(weights.sum(1), 1e-9)
    mean = np.einsum("nk,nkc->nc", weights, values) / total[:, None]
    apart = np.linalg.norm(values - mean[:, None], axis=2)
    return mean.astype(np.float32), apart.astype(np.float32)


def _from_nearest(points: F32, values: F32, seen: NDArray[np.bool_]) -> F32:
    """Values for the unseen points: the mean of the four nearest seen ones, nearer counts more."""
    from scipy.spatial import cKDTree

    sources = np.flatnonzero(seen)
    sources = sources[:: max(1, len(sources) // 300_000)]
    distance, nearest = cKDTree(points[sources]).query(points[~seen], k=min(4, len(sources)))
    distance, nearest = distance.reshape(len(distance), -1), nearest.reshape(len(nearest), -1)
    weights = 1 / np.maximum(distance, 1e-9)
    weights /= weights.sum(1, keepdims=True)
    return np.asarray(np.einsum("nk,nkc->nc", weights, values[sources][nearest]), np.float32)
