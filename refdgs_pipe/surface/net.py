"""A mesh as a net of vertices, and parts of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from refdgs_pipe.artifacts.mesh import TriangleMesh

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

SMOOTH = 0.01  # of the ball's diameter, by which normals are smoothed before they are compared


@dataclass(frozen=True)
class Net:
    """A mesh as a net of V vertices.

    Args:
        beside: (V, V) 1 for neighbours; lengths: (V, V) of the edges, world units.
        area: (V,) a third of the faces around.
        smooth: (V, 3) unit normals, smoothed; rim: (V,) on an open rim.
        step: median length of an edge, world units.
    """

    points: F64
    beside: csr_array
    lengths: csr_array
    area: F64
    smooth: F64
    rim: Bools
    step: float

    @classmethod
    def of(cls, mesh: TriangleMesh, diameter: float) -> "Net":
        points, count = mesh.vertices.astype(np.float64), len(mesh.vertices)
        corners = mesh.faces.astype(np.int64)
        pairs = np.sort(np.stack([corners, np.roll(corners, -1, 1)], -1).reshape(-1, 2), axis=1)
        links, times = np.unique(pairs, axis=0, return_counts=True)
        a, b = links.T
        ones = np.ones(2 * len(links))
        ends = (np.r_[a, b], np.r_[b, a])
        beside = csr_array((ones, ends), shape=(count, count))
        apart = np.linalg.norm(points[a] - points[b], axis=1)
        lengths = csr_array((np.r_[apart, apart], ends), shape=(count, count))
        p, q, r = (points[corners[:, i]] for i in range(3))
        faces = np.linalg.norm(np.cross(q - p, r - p), axis=1) / 2
        thirds = np.bincount(corners.ravel(), np.repeat(faces / 3, 3), minlength=count)
        area = np.asarray(thirds, np.float64)
        step = float(np.median(apart))
        normals: F64 = mesh.vertex_normals().astype(np.float64) * area[:, None]
        for _ in range(max(1, round(SMOOTH * diameter / step))):
            normals += np.asarray(beside @ normals, np.float64)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        rim = np.zeros(count, bool)
        rim[links[times == 1]] = True
        return cls(points, beside, lengths, area, normals, rim, step)

    def outwards(self, part: Bools) -> F64:
        """(3,) normal of the plane of a part, on the outside of the surface."""
        normal = plane_of(self.points[part], self.area[part])[1]
        return normal * np.sign((self.area[part] @ self.smooth[part]) @ normal)


def pieces_of(net: Net, chosen: Bools, least: float) -> list[Bools]:
    """Connected parts of the chosen vertices with at least this area, largest first."""
    rows = np.flatnonzero(chosen)
    labels = connected_components(net.beside[rows][:, rows], directed=False)[1]
    areas = np.bincount(labels, net.area[rows])
    out = []
    for label in np.argsort(-areas, kind="stable"):
        if areas[label] < least:
            break
        part = np.zeros(len(chosen), bool)
        part[rows[labels == label]] = True
        out.append(part)
    return out


def plane_of(points: F64, weight: F64) -> tuple[F64, F64]:
    """Centre and unit normal of the plane of least squares."""
    center = np.average(points, axis=0, weights=weight)
    away = points - center
    return center, np.linalg.eigh((away * weight[:, None]).T @ away)[1][:, 0]
