"""How far a mesh lies off the surface, told by its outlines and those that the cameras see.

Fused depth lies a little behind the surface: where surfels overlap, the mean depth of a ray is
that of deeper ones too. Outlines have no such bias, and every convex place is on some.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.geometry import hit_depth, outline_distance
from refdgs_pipe.ray_casting import Solid

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_GRAZING = 0.2  # cosine: the vertex is where the surface turns away from the eye
_OUTSIDE = 1.5  # pixels beyond the vertex, where the eye must see past the mesh
MOST = 12.0  # views that count for a vertex
_STIFFNESS = 30.0  # of the displacement between neighbours, against one view
_REST = 0.003  # of staying where no outline is near
_REMAP = 30000  # cv2.remap refuses more than 32767 rows


@dataclass(frozen=True)
class Outline:
    """Where one camera sees the object.

    Args:
        inside: (H, W) pixels from each pixel's centre to the outline, negative outside.
    """

    camera: Camera
    inside: F32

    @classmethod
    def of(cls, camera: Camera, covered: NDArray[np.bool_]) -> "Outline":
        """From the pixels (H, W) that are covered."""
        return cls(camera, outline_distance(covered))

    def at(self, pixels: F64) -> F32:
        """(N,) the distances at pixel coordinates (N, 2)."""
        return looked_up(self.inside, pixels)[:, 0]

    @classmethod
    def of_mesh(cls, camera: Camera, solid: Solid) -> "Outline":
        """Where a mesh would be seen."""
        return cls.of(camera, hit_depth(solid, camera) > 0)


def outline_pull(
    mesh: TriangleMesh, normals: F32, solid: Solid, outlines: Iterable[Outline], *, limit: float
) -> tuple[F64, F64]:
    """How many views tell of each vertex (V,), and how far it should move outwards times that.

    Args:
        limit: outlines further away than this are another part's, world units.
    """
    count, total = (np.zeros(len(mesh.vertices)) for _ in range(2))
    for outline in outlines:
        vertices, wanted = _wanted(mesh, normals, solid, outline, limit)
        np.add.at(count, vertices, 1)
        np.add.at(total, vertices, wanted)
    return count, total


def _wanted(
    mesh: TriangleMesh, normals: F32, solid: Solid, outline: Outline, limit: float
) -> tuple[Ints, F64]:
    """Vertices on one view's outline of the mesh, and how far each should move outwards."""
    camera = outline.camera
    pixels, depth = camera.project(mesh.vertices.astype(np.float64))
    toward = camera.center - mesh.vertices
    cosine = (toward * normals).sum(1) / np.maximum(np.linalg.norm(toward, axis=1), 1e-9)
    size = np.array([camera.width, camera.height])
    there = (depth > 0) & (pixels >= 1).all(1) & (pixels <= size - 1).all(1)
    rows = np.flatnonzero(there & (np.abs(cosine) < _GRAZING))
    pixel = depth[rows] / float(camera.K[0, 0])  # world units
    past = mesh.vertices[rows] + (_OUTSIDE * pixel)[:, None] * normals[rows] - camera.center
    blocked = np.zeros(len(rows), bool)
    blocked[solid.first(camera.center.astype(np.float32), past.astype(np.float32)).rays] = True
    rows, pixel = rows[~blocked], pixel[~blocked]
    if not len(rows):
        return rows, np.zeros(0)
    own = Outline.of_mesh(camera, solid)
    x, y = (np.ascontiguousarray(pixels[rows, i] - 0.5, np.float32)[:, None] for i in (0, 1))
    apart = outline.inside - own.inside
    looked_up = [
        cv2.remap(apart, x[i : i + 30000], y[i : i + 30000], cv2.INTER_LINEAR)
        for i in range(0, len(rows), 30000)
    ]
    wanted = np.concatenate(looked_up)[:, 0] * pixel
    near = np.abs(wanted) < limit
    return rows[near], wanted[near]


def looked_up(picture: F32, pixels: F64) -> F32:
    """(N, C) bilinear values of a picture (H, W[, C]) at pixel coordinates (N, 2)."""
    x, y = (np.ascontiguousarray(pixels[:, i] - 0.5, np.float32)[:, None] for i in (0, 1))
    parts = [
        cv2.remap(picture, x[i : i + _REMAP], y[i : i + _REMAP], cv2.INTER_LINEAR)
        for i in range(0, len(x), _REMAP)
    ]
    channels = picture.shape[2] if picture.ndim == 3 else 1
    empty = np.zeros((0, channels), np.float32)
    return np.concatenate([empty, *(part.reshape(-1, channels) for part in parts)])


def spread_evenly(
    weight: F64, pull: F64, links: Ints, *, stiffness: float = _STIFFNESS, rest: float = _REST
) -> F64:
    """(V,) displacements near what is wanted, alike between neighbours, else small.

    Args:
        weight: (V,) of what each place wants; pull: (V,) that times what it wants.
        links: (E, 2) neighbours.
        stiffness, rest: weights of neighbours' moving alike, and of staying.
    """
    count = len(weight)
    a, b = links.T
    ones = np.full(len(links), stiffness)
    across = coo_array((np.r_[ones, ones], (np.r_[a, b], np.r_[b, a])), shape=(count, count))
    degree = np.asarray(across.sum(1)).reshape(-1)
    system = diags_array(degree + weight + rest) - across.tocsr()
    found, _ = cg(system, pull, rtol=1e-4, maxiter=500)
    return np.asarray(found, np.float64)
