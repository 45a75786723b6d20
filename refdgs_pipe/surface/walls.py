"""Walls below open rims, as of a plate that lies on its back: views see them, fusion loses them.

A wall of a pixel or two lies wholly beside a jump in depth. Views from aslant see where it ends:
there the outline is the rim's, moved outwards and moved down, and from above the rim's, moved
outwards alone. So both are found by least squares from all views that see the rim's outline.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.ray_casting import Solid
from refdgs_pipe.surface.rims import Rim, rim_of
from refdgs_pipe.surface.silhouettes import Outline

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_OUTSIDE = 1.5  # pixels beyond the rim, where the eye must see past the mesh
_TURNED = 0.3  # least share of a move that the eye sees as one across the outline
_PASSES = 40  # of averaging what is known along the rim
_REST = 0.2  # views that say that the rim is right as it is
_REACH = 4.0  # walls are at most this high, in `limit`
_LEVEL = 0.5  # of `limit`: rims that leave their plane by more are torn, not the edge of a part
_LEAST = 0.3  # pixels: lower walls are noise


@dataclass(frozen=True)
class _Known:
    """Sums over views for each rim vertex: of moves outwards (a), downwards (b) and wanted (w)."""

    aa: F64
    ab: F64
    bb: F64
    aw: F64
    bw: F64
    pixel: F64
    count: F64


def with_walls(
    mesh: TriangleMesh, outlines: Sequence[Outline], *, limit: float, faces: int
) -> TriangleMesh:
    """The mesh with walls below those of its open rims that views see to have one.

    Args:
        limit: a wall is at most some times as high, world units.
        faces: the most that the result may have.
    """
    rim = rim_of(mesh)
    if not len(rim.vertices):
        return mesh
    loop = _loops(rim)
    rim, down = _level(mesh, rim, loop)
    out, height, pixel = _moves(mesh, rim, down, outlines, limit)
    chosen = np.zeros(len(height), bool)
    left = faces - len(mesh.faces)
    for number in np.bincount(loop).argsort()[::-1]:
        here = loop == number
        needed = 2 * int(here.sum())
        level = (mesh.vertices[rim.vertices[here]] * down[here]).sum(1).std() < _LEVEL * limit
        if level and needed <= left and np.median(height[here] / pixel[here]) > _LEAST:
            chosen |= here
            left -= needed
    if not chosen.any():
        return mesh
    height = np.maximum(height, _LEAST / 3 * pixel)
    return _built(mesh, rim, chosen, (out[:, None] * rim.outwards, height[:, None] * down))


def _level(mesh: TriangleMesh, rim: Rim, loop: Ints) -> tuple[Rim, F64]:
    """The rim with ways outwards that lie in the plane of each loop, and (R, 3) ways down."""
    points = mesh.vertices[rim.vertices].astype(np.float64)
    along = np.zeros_like(points)
    for here, there, sign in ((0, 1, 1), (1, 0, -1)):
        step = points[rim.links[:, there]] - points[rim.links[:, here]]
        np.add.at(along, rim.links[:, here], sign * step)
    down = np.zeros_like(points)
    normals = mesh.vertex_normals()[rim.vertices]
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    for number in range(int(loop.max()) + 1):
        here = loop == number
        centre = points[here].mean(0)
        axis = np.linalg.svd(points[here] - centre, full_matrices=False)[2][2]
        away = (centre - mesh.vertices.mean(0)) / size - normals[here].mean(0)
        down[here] = axis * np.sign(away @ axis)
    out = np.cross(along, down)
    out *= np.sign((out * rim.outwards).sum(1, keepdims=True))
    length = np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
    return Rim(rim.vertices, rim.links, out / length), down


def _moves(
    mesh: TriangleMesh, rim: Rim, down: F64, outlines: Sequence[Outline], limit: float
) -> tuple[F64, F64, F64]:
    """(R,) how far the rim lies inside its place, the wall's height, a pixel; world units."""
    solid = Solid(mesh.vertices, mesh.faces)
    sums = np.zeros((len(rim.vertices), 7))
    for outline in outlines:
        rows, told = _told(mesh, rim, down, solid, outline, limit)
        sums[rows] += told
    degree = np.maximum(np.bincount(rim.links.reshape(-1), minlength=len(sums)), 1)[:, None]
    for _ in range(_PASSES):
        around = np.zeros_like(sums)
        for here, there in ((0, 1), (1, 0)):
            np.add.at(around, rim.links[:, here], sums[rim.links[:, there]])
        sums = (sums + around / degree) / 2
    known = _Known(*sums.T)
    aa, bb = known.aa + _REST, known.bb + _REST
    volume = np.maximum(aa * bb - known.ab**2, 1e-9)
    out = (bb * known.aw - known.ab * known.bw) / volume
    height = (aa * known.bw - known.ab * known.aw) / volume
    out = np.where(height > 0, out, known.aw / aa)
    pixel = known.pixel / np.maximum(known.count, 1e-9)
    return (
        np.clip(out, -limit, limit),
        np.clip(height, 0, _REACH * limit),
        np.where(pixel > 0, pixel, np.inf),
    )


def _told(
    mesh: TriangleMesh, rim: Rim, down: F64, solid: Solid, outline: Outline, limit: float
) -> tuple[Ints, F64]:
    """Rows of the rim that are on one view's outline of the mesh, and what it adds to the sums."""
    camera = outline.camera
    points = mesh.vertices[rim.vertices].astype(np.float64)
    pixels, depth = camera.project(points)
    size = np.array([camera.width, camera.height])
    rows = np.flatnonzero((depth > 0) & (pixels >= 3).all(1) & (pixels <= size - 3).all(1))
    points, pixels, depth = points[rows], pixels[rows], depth[rows]
    pixel = depth / float(camera.K[0, 0])
    step = np.stack([[1.0, 0.0], [0.0, 1.0]])
    slope = np.stack([outline.at(pixels + s) - outline.at(pixels - s) for s in step], 1)
    beyond = -slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-6)

    def across(way: F64) -> F64:
        """Share of a move along it that goes out of the outline."""
        moved, _ = camera.project(points + 1e-3 * depth[:, None] * way[rows])
        pace = (moved - pixels) * (pixel / (1e-3 * depth))[:, None]
        return np.asarray((pace * beyond).sum(1), np.float64)

    a, b = across(rim.outwards), np.maximum(across(down), 0)
    wanted = outline.at(pixels).astype(np.float64) * pixel
    aside = np.column_stack([pixels + _OUTSIDE * beyond, np.ones(len(pixels))])
    rays = aside @ np.linalg.inv(camera.K).T @ camera.cam_from_world[:3, :3]
    free = np.ones(len(rows), bool)
    free[solid.first(camera.center.astype(np.float32), rays.astype(np.float32)).rays] = False
    free &= (np.maximum(a, b) > _TURNED) & (np.abs(wanted) < _REACH * limit)
    told = np.stack([a * a, a * b, b * b, a * wanted, b * wanted, pixel, np.ones(len(a))], 1)
    return rows[free], told[free]


def _loops(rim: Rim) -> Ints:
    """(R,) which loop each vertex of a rim belongs to."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(rim.vertices)
    a, b = rim.links.T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _built(
    mesh: TriangleMesh, rim: Rim, chosen: NDArray[np.bool_], moves: tuple[F64, F64]
) -> TriangleMesh:
    """The mesh with a strip below the chosen vertices of its rim, which move outwards."""
    outwards, downwards = moves
    vertices = mesh.vertices.astype(np.float64)
    vertices[rim.vertices[chosen]] += outwards[chosen]
    low = np.full(len(rim.vertices), -1)
    low[chosen] = len(vertices) + np.arange(int(chosen.sum()))
    below = vertices[rim.vertices[chosen]] + downwards[chosen]
    i, j = rim.links[chosen[rim.links].all(1)].T
    top_i, top_j = rim.vertices[i], rim.vertices[j]
    strip = np.concatenate(
        [np.stack([top_j, top_i, low[i]], 1), np.stack([top_j, low[i], low[j]], 1)]
    )
    return TriangleMesh(
        np.concatenate([vertices, below]).astype(np.float32),
        np.concatenate([mesh.faces, strip.astype(np.int32)]),
    )
