"""Move a mesh along its normals until its outlines are those that the cameras see.

Fused depth lies a little behind the surface: where surfels overlap, the mean depth of a ray is
that of deeper ones too. Outlines have no such bias, and every convex place is on some.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from refdgs_pipe.artifacts.mesh import Mesh, TriangleMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.received import links_of
from refdgs_pipe.tracing import Solid

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_LONGEST = 640  # pixels: more do not make an outline much sharper
_COVERED = 0.5  # alpha
_LIMIT = 0.01  # diameters of the object ball: further away is another part's outline
_GRAZING = 0.2  # cosine: the vertex is where the surface turns away from the eye
_OUTSIDE = 1.5  # pixels beyond the vertex, where the eye must see past the mesh
_MOST = 12.0  # views that count for a vertex
_STIFFNESS = 30.0  # of the displacement between neighbours, against one view
_REST = 0.003  # of staying where no outline is near


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
        solid = covered.astype(np.uint8)
        within = cv2.distanceTransform(solid, cv2.DIST_L2, 5)
        beyond = cv2.distanceTransform(1 - solid, cv2.DIST_L2, 5)
        inside = np.where(solid > 0, within - 0.5, 0.5 - beyond)
        return cls(camera, inside.astype(np.float32))

    @classmethod
    def of_mesh(cls, camera: Camera, solid: Solid) -> "Outline":
        """Where a mesh would be seen."""
        rays = camera.pixel_rays().reshape(-1, 3) @ camera.cam_from_world[:3, :3]
        covered = np.zeros(len(rays), bool)
        hits = solid.first(camera.center.astype(np.float32), rays.astype(np.float32))
        covered[hits.rays] = True
        return cls.of(camera, covered.reshape(camera.height, camera.width))


def fitted(
    mesh: Mesh,
    model: SparseModel,
    draw: Callable[[Camera], SurfaceMap],
    *,
    rounds: int,
    track: Callable[[list[Camera], str], Iterable[Camera]],
) -> Mesh:
    """The mesh fitted to the outlines that training cameras see of the object.

    Args:
        draw: what a camera sees.
        track: wraps the cameras, to report progress under a label.
    """
    if not rounds:
        return mesh
    cameras = [c for c in model.cameras if c.split == "train"] or list(model.cameras)
    outlines = []
    for camera in track(cameras, "looking at outlines"):
        view = draw(camera.fitted(_LONGEST))
        outlines.append(Outline.of(view.camera, view.alpha >= _COVERED))
    limit = _LIMIT * 2 * model.ball.radius
    moved = fit_outlines(mesh, outlines, limit=limit, rounds=rounds)
    return Mesh(moved.vertices, moved.faces)


def fit_outlines(
    mesh: TriangleMesh, outlines: Sequence[Outline], *, limit: float, rounds: int
) -> TriangleMesh:
    """The mesh with its vertices moved along their normals.

    Args:
        limit: outlines further away than this are another part's, world units.
        rounds: times that the outlines are looked up and the vertices moved.
    """
    links = links_of(mesh.faces)
    for _ in range(rounds):
        normals = mesh.vertex_normals()
        solid = Solid(mesh.vertices, mesh.faces)
        count, total = (np.zeros(len(mesh.vertices)) for _ in range(2))
        for outline in outlines:
            vertices, wanted = _wanted(mesh, normals, solid, outline, limit)
            np.add.at(count, vertices, 1)
            np.add.at(total, vertices, wanted)
        moved = _spread(count, total, links)
        points = mesh.vertices + moved[:, None] * normals
        mesh = TriangleMesh(points.astype(np.float32), mesh.faces)
    return mesh


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


def _spread(count: F64, total: F64, links: Ints) -> F64:
    """(V,) displacements near what the outlines want, alike between neighbours, else small."""
    vertices = len(count)
    weight = np.minimum(count, _MOST)
    pull = np.where(count > 0, total / np.maximum(count, 1), 0) * weight
    a, b = links.T
    ones = np.full(len(links), _STIFFNESS)
    shape = (vertices, vertices)
    across = coo_array((np.r_[ones, ones], (np.r_[a, b], np.r_[b, a])), shape=shape).tocsr()
    degree = np.asarray(across.sum(1)).reshape(-1)
    system = diags_array(degree + weight + _REST) - across
    found, _ = cg(system, pull, rtol=1e-4, maxiter=500)
    return np.asarray(found, np.float64)
