"""Even out the open rims of a mesh and move them to where the cameras see the object end.

What no camera saw is not in the mesh. Where seen and unseen meet, as at the edge of a plate that
lies on its back, fusion leaves the rim frayed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.irradiance import links_of
from refdgs_pipe.ray_casting import Solid
from refdgs_pipe.surface.silhouettes import MOST, Outline, spread_evenly
from refdgs_pipe.vectors import unit

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_PASSES = 4  # of smoothing along the rim
_OUTSIDE = 1.5  # pixels beyond the rim, where the eye must see past the mesh
_ACROSS = 0.5  # least sine between the eye's ray and the way out of the surface
_STIFFNESS = 4.0  # of the displacement between neighbours, against one view
_ALONG = 4.0  # the same along the rim
_FIRM, _REST = 100.0, 0.5  # of the rim's place, and of the rest's staying where it is


@dataclass(frozen=True)
class Rim:
    """The open rims of a mesh.

    Args:
        vertices: (R,) on them; links: (E, 2) rows of `vertices` that are neighbours.
        outwards: (R, 3) unit, along the surface and away from it.
    """

    vertices: Ints
    links: Ints
    outwards: F64


def rim_of(mesh: TriangleMesh) -> Rim:
    """The edges that have one face only."""
    corners = mesh.faces.astype(np.int64)
    edges = np.stack([corners, np.roll(corners, -1, axis=1)], -1).reshape(-1, 2)
    _, first, count = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True
    )
    open_edges = first[count == 1]
    ends, face = edges[open_edges], corners[open_edges // 3]
    a, b, c = (mesh.vertices[face[:, i]].astype(np.float64) for i in range(3))
    along = mesh.vertices[ends[:, 1]].astype(np.float64) - mesh.vertices[ends[:, 0]]
    out = np.cross(along, unit(np.cross(b - a, c - a)))
    vertices, rows = np.unique(ends, return_inverse=True)
    links = rows.reshape(-1, 2)
    total = np.zeros((len(vertices), 3))
    for i in range(2):
        np.add.at(total, links[:, i], out)
    return Rim(vertices, links, unit(total))


def fit_rims(mesh: TriangleMesh, outlines: Sequence[Outline], *, limit: float) -> TriangleMesh:
    """The mesh with even rims that end where the views see it end; its other vertices follow.

    Args:
        limit: outlines further away than this are another part's, world units.
    """
    rim = rim_of(mesh)
    if not len(rim.vertices):
        return mesh
    even = mesh.vertices[rim.vertices].astype(np.float64)
    degree = np.bincount(rim.links.reshape(-1), minlength=len(even))[:, None]
    for _ in range(_PASSES):
        around = np.zeros_like(even)
        for here, there in ((0, 1), (1, 0)):
            np.add.at(around, rim.links[:, here], even[rim.links[:, there]])
        even = (even + around / np.maximum(degree, 1)) / 2
    mesh = _dragged(mesh, rim, even)
    rim = rim_of(mesh)
    solid = Solid(mesh.vertices, mesh.faces)
    count, total = (np.zeros(len(rim.vertices)) for _ in range(2))
    for outline in outlines:
        rows, wanted = _wanted(mesh, rim, solid, outline, limit)
        count[rows] += 1
        total[rows] += wanted
    weight = np.minimum(count, MOST)
    pull = weight * total / np.maximum(count, 1)
    moved = spread_evenly(weight, pull, rim.links, stiffness=_ALONG)
    return _dragged(mesh, rim, mesh.vertices[rim.vertices] + moved[:, None] * rim.outwards)


def _wanted(
    mesh: TriangleMesh, rim: Rim, solid: Solid, outline: Outline, limit: float
) -> tuple[Ints, F64]:
    """Rows of the rim that one view sees against what is not the mesh, and how far out they go."""
    camera = outline.camera
    points = mesh.vertices[rim.vertices].astype(np.float64)
    pixels, depth = camera.project(points)
    toward = camera.center - points
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)
    across = np.sqrt(np.maximum(1 - (toward * rim.outwards).sum(1) ** 2, 0))
    size = np.array([camera.width, camera.height])
    there = (depth > 0) & (pixels >= 1).all(1) & (pixels <= size - 1).all(1)
    rows = np.flatnonzero(there & (across > _ACROSS))
    pixel = depth[rows] / float(camera.K[0, 0])
    past = points[rows] + (_OUTSIDE * pixel / across[rows])[:, None] * rim.outwards[rows]
    rays = (past - camera.center).astype(np.float32)
    free = np.ones(len(rows), bool)
    free[solid.first(camera.center.astype(np.float32), rays).rays] = False
    rows, pixel = rows[free], pixel[free]
    wanted = outline.at(pixels[rows]) * pixel / across[rows]
    near = np.abs(wanted) < limit
    return rows[near], wanted[near]


def _dragged(mesh: TriangleMesh, rim: Rim, wanted: F64) -> TriangleMesh:
    """The mesh with its rim at (R, 3) points; what is beside the rim follows in part."""
    weight = np.zeros(len(mesh.vertices))
    weight[rim.vertices] = _FIRM
    links = links_of(mesh.faces)
    points = mesh.vertices.astype(np.float64)
    for axis in range(3):
        pull = np.zeros(len(points))
        pull[rim.vertices] = _FIRM * (wanted[:, axis] - points[rim.vertices, axis])
        points[:, axis] += spread_evenly(weight, pull, links, stiffness=_STIFFNESS, rest=_REST)
    return TriangleMesh(points.astype(np.float32), mesh.faces)
