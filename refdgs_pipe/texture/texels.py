"""The texels of an atlas: which face each one shows, and filling the ones between charts."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import UvMesh

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_ALONG = 8  # places looked at along an edge that is cut
_CHUNK = 1 << 22  # candidate texels looked at together: bounds the memory


@dataclass(frozen=True)
class Texels:
    """The covered texels of a square atlas, one row each.

    Args:
        size: texels along a side. Texel (row, column) has its centre at uv
            ((column + 0.5) / size, (row + 0.5) / size).
        index: (N,) row * size + column, rising.
        face: (N,) the face seen there; weights: (N, 3) of the face's corners.
    """

    size: int
    index: Ints
    face: NDArray[np.int32]
    weights: F32

    def interpolate(self, mesh: UvMesh, values: F32) -> F32:
        """(N, C) values given per vertex (V, C)."""
        corners = mesh.faces[self.face]
        total = np.zeros((len(self.index), values.shape[1]), np.float32)
        for i in range(3):
            total += self.weights[:, i, None] * values[corners[:, i]]
        return total

    def beside(self) -> tuple[F32, F32]:
        """Texture coordinates (K, 2) of the texels next to the charts, and of the nearest covered.

        Looking up near a chart's border reads both.
        """
        nearest, distance = self._nearest()
        rows = np.argwhere((distance > 0) & (distance < 2))
        there = nearest[:, rows[:, 0], rows[:, 1]].T
        uv = [(np.float32(0.5) + at[:, ::-1]) / np.float32(self.size) for at in (rows, there)]
        return uv[0].astype(np.float32), uv[1].astype(np.float32)

    def _nearest(self) -> tuple[Ints, F64]:
        """(2, size, size) row and column of the nearest covered texel, and how far it is."""
        from scipy.ndimage import distance_transform_edt

        covered = np.zeros(self.size**2, bool)
        covered[self.index] = True
        bare = ~covered.reshape(self.size, self.size)
        distance, nearest = distance_transform_edt(bare, return_indices=True)
        return nearest, distance

    def picture(self, values: NDArray[Any]) -> NDArray[Any]:
        """(size, size[, C]) values (N[, C]) in place; texels between charts copy the nearest."""
        shape = (self.size, self.size)
        flat = np.zeros((self.size**2, *values.shape[1:]), values.dtype)
        flat[self.index] = values
        nearest, _ = self._nearest()
        image = flat.reshape(*shape, *values.shape[1:])
        return np.ascontiguousarray(image[nearest[0], nearest[1]])


def rasterize(mesh: UvMesh, size: int) -> Texels:
    """The texels whose centre lies in a face of the atlas."""
    corners = mesh.uv[mesh.faces]
    face = np.full(size * size, -1, np.int32)
    weights = np.zeros((size * size, 3), np.float32)
    for index, candidate, inside in _candidates(corners, size):
        face[index], weights[index] = candidate, inside
    covered = np.flatnonzero(face >= 0)
    return Texels(size, covered, face[covered], weights[covered])


def cuts(mesh: UvMesh) -> tuple[F32, F32]:
    """Texture coordinates (K, 2) and (K, 2) of the same places on both sides of the cuts."""
    _, solid = np.unique(mesh.vertices, axis=0, return_inverse=True)
    edges = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], -1).reshape(-1, 2)
    ends = solid.reshape(-1)[edges]
    edges = np.where((ends[:, 0] < ends[:, 1])[:, None], edges, edges[:, ::-1])
    ends = np.sort(ends, axis=1)
    order = np.lexsort(ends.T)
    edges, ends = edges[order], ends[order]
    pairs = np.flatnonzero((ends[1:] == ends[:-1]).all(1))
    one, other = edges[pairs], edges[pairs + 1]
    cut = (one != other).any(1)
    part = ((np.arange(_ALONG) + 0.5) / _ALONG).astype(np.float32)[:, None, None]
    places = [
        (mesh.uv[side[cut, 0]] * (1 - part) + mesh.uv[side[cut, 1]] * part).reshape(-1, 2)
        for side in (one, other)
    ]
    return places[0], places[1]


def coverage(corners: F32, size: int) -> NDArray[np.int32]:
    """(size, size) how many faces, given by their corners (F, 3, 2), cover each texel's centre."""
    count = np.zeros(size * size, np.int32)
    for index, _, weights in _candidates(corners, size):
        # Well inside, so that a centre on a shared edge does not count twice.
        count += np.bincount(index[weights.min(1) > 1e-3], minlength=size * size).astype(np.int32)
    return count.reshape(size, size)


def _candidates(corners: F32, size: int) -> Iterator[tuple[Ints, Ints, F32]]:
    """Chunks of (texel index, face, corner weights) for all texel centres in all faces."""
    points = corners.astype(np.float64) * size - 0.5  # texel centres are whole numbers
    low = np.clip(np.ceil(points.min(1)), 0, size).astype(np.int64)
    high = np.clip(np.floor(points.max(1)) + 1, 0, size).astype(np.int64)
    width = np.maximum(high - low, 0)
    counts = width.prod(1)
    ends = np.cumsum(counts)
    start = 0
    while start < len(points):
        done = ends[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, done + _CHUNK, side="right")))
        face = np.repeat(np.arange(start, stop), counts[start:stop])
        rank = np.arange(len(face)) + done - (ends - counts)[face]
        x = low[face, 0] + rank % np.maximum(width[face, 0], 1)
        y = low[face, 1] + rank // np.maximum(width[face, 0], 1)
        weights = _corner_weights(points[face], x, y)
        inside = (weights >= 0).all(1)
        yield (y * size + x)[inside], face[inside], weights[inside].astype(np.float32)
        start = stop


def _corner_weights(triangles: F64, x: Ints, y: Ints) -> F64:
    """(N, 3) barycentric weights of points in triangles (N, 3, 2); negative outside."""
    ax, ay = triangles[:, 0].T
    ux, uy = (triangles[:, 1] - triangles[:, 0]).T
    vx, vy = (triangles[:, 2] - triangles[:, 0]).T
    area = ux * vy - uy * vx
    flat = np.abs(area) < 1e-12
    area = np.where(flat, 1, area)
    b = ((x - ax) * vy - (y - ay) * vx) / area
    c = (ux * (y - ay) - uy * (x - ax)) / area
    return np.where(flat[:, None], -1.0, np.stack([1 - b - c, b, c], -1))
