"""Rays against a triangle mesh (Embree, by open3d)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Hits:
    """What rays met first.

    Args:
        rays: (N,) rows of the rays that met anything, rising.
        face: (N,) which face; weights: (N, 3) of its corners.
        distance: (N,) in lengths of the ray's direction.
    """

    rays: Ints
    face: Ints
    weights: F32
    distance: F32

    def chosen(self, which: Ints | slice) -> "Hits":
        """Some of them."""
        return Hits(self.rays[which], self.face[which], self.weights[which], self.distance[which])


class Solid:
    """A mesh that rays can meet.

    Args:
        vertices: (V, 3); faces: (F, 3).
    """

    def __init__(self, vertices: F32, faces: NDArray[np.int32]) -> None:
        import open3d as o3d

        self._tensor: Any = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(vertices, np.float32)),
            self._tensor(np.ascontiguousarray(faces, np.uint32)),
        )

    def first(self, origins: F32, directions: F32) -> Hits:
        """What rays (N, 3) from origins (N, 3), or from one (3,), meet first."""
        parts = []
        for start in range(0, max(1, len(directions)), _CHUNK):
            toward = directions[start : start + _CHUNK]
            part = origins if origins.ndim == 1 else origins[start : start + _CHUNK]
            rays = np.concatenate([np.broadcast_to(part, toward.shape), toward], 1)
            found = self._scene.cast_rays(self._tensor(np.ascontiguousarray(rays, np.float32)))
            distance = found["t_hit"].numpy()
            there = np.flatnonzero(np.isfinite(distance))
            b, c = found["primitive_uvs"].numpy()[there].T
            parts.append(
                Hits(
                    there + start,
                    found["primitive_ids"].numpy()[there].astype(np.int64),
                    np.stack([1 - b - c, b, c], 1).astype(np.float32),
                    distance[there],
                )
            )
        if len(parts) == 1:
            return parts[0]
        fields = ("rays", "face", "weights", "distance")
        return Hits(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))

    def nearest(self, points: F32) -> tuple[Ints, F32]:
        """The places of the mesh that are nearest to points (N, 3): (N,) faces, (N, 3) weights."""
        found = self._scene.compute_closest_points(
            self._tensor(np.ascontiguousarray(points, np.float32))
        )
        b, c = found["primitive_uvs"].numpy().T
        weights = np.stack([1 - b - c, b, c], 1).astype(np.float32)
        return found["primitive_ids"].numpy().astype(np.int64), weights


def at_hits(values: F32, faces: NDArray[np.int32], face: Ints, weights: F32) -> F32:
    """(N, C) values given per vertex (V, C), at places in faces."""
    corners = np.take(faces, face, axis=0)
    total = weights[:, :1] * np.take(values, corners[:, 0], axis=0)
    for i in (1, 2):
        total = total + weights[:, i : i + 1] * np.take(values, corners[:, i], axis=0)
    return np.asarray(total, np.float32)


def cosine_rays(normals: F32, count: int, number: int) -> F32:
    """(N, 3) one of `count` directions about each normal, denser around it (Malley's method).

    These are `half_vectors` of alpha 1.
    """
    return half_vectors(normals, 1.0, count, number)


def half_vectors(normals: F32, alpha: F32 | float, count: int, number: int) -> F32:
    """(N, 3) one of `count` unit half vectors about each normal, with the density D (n.h) of GGX.

    The vectors of one normal are spread evenly (a Fibonacci spiral); each normal's spiral is
    turned by an angle of its own, so that neighbours do not err alike. Nothing is random.

    Args:
        alpha: of GGX, the square of the roughness: one, or (N, 1).
    """
    golden = 0.6180339887498949
    turn = (np.arange(len(normals)) * golden) % 1.0
    part = (number + 0.5) / count
    radius = alpha * np.sqrt(part / (1 + (alpha**2 - 1) * part))
    angle = 2 * np.pi * ((number * golden) % 1.0 + turn)
    across, along = perpendicular(normals)
    height = np.sqrt(1 - radius**2)
    out = (
        radius * np.cos(angle)[:, None] * across
        + radius * np.sin(angle)[:, None] * along
        + height * normals
    )
    return np.asarray(out, np.float32)


def perpendicular(normals: F32) -> tuple[F32, F32]:
    """Two unit vectors (N, 3) that stand on each unit normal and on each other."""
    helper = np.eye(3, dtype=np.float32)[np.abs(normals).argmin(1)]
    across = np.cross(normals, helper)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    return np.asarray(across, np.float32), np.asarray(np.cross(normals, across), np.float32)
