"""What a mesh tells of itself: rims that should not be there, loose bits, what photos saw."""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh, UvMesh
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.ray_casting import Solid, at_hits

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

WELL = 0.7  # confidence from which on a shape counts as known: 0.46 % of the diagonal
_LOW = 0.25  # of the object's height: a rim that lies lower can be that of the bottom
_BIT = 0.05  # of the surface: larger pieces can be parts of the object
_STRAY = 0.01  # of the surface, that may lie lower than the object ends
_STANDS = 0.03  # of the diagonal: how far above the lowest piece another one stands too
_TOUCHES = 0.01  # of the diagonal: how far apart two pieces hold each other
_TRIED = 20_000  # points of a piece, that are compared with other pieces


def open_rims(mesh: TriangleMesh | UvMesh) -> tuple[F64, F64]:
    """The loops of edges that have a face on one side only; charts are joined again.

    Returns:
        (R,) their lengths in world units, and (R, 3) their centres.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    points, faces = _welded(mesh)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    unique, counts = np.unique(edges, axis=0, return_counts=True)
    rim = unique[counts == 1]
    if not len(rim):
        return np.zeros(0), np.zeros((0, 3))
    links = coo_array((np.ones(len(rim)), (rim[:, 0], rim[:, 1])), shape=(len(points),) * 2)
    _, part = connected_components(links, directed=False)
    loops, of = np.unique(part[rim[:, 0]], return_inverse=True)
    length = np.linalg.norm(points[rim[:, 0]] - points[rim[:, 1]], axis=1)
    lengths = np.asarray(np.bincount(of, length, len(loops)), np.float64)
    middle = (points[rim[:, 0]] + points[rim[:, 1]]) / 2
    sums = [np.bincount(of, length * middle[:, i], len(loops)) for i in range(3)]
    return lengths, np.stack(sums, -1) / np.maximum(lengths, 1e-30)[:, None]


def open_holes(mesh: TriangleMesh, up: F64) -> tuple[int, float]:
    """How many open rims a mesh has, and their length in world units, without that of a bottom.

    The longest rim is the bottom's if it lies in the lowest quarter of the mesh: what the object
    stands on hides its underside.

    Args:
        up: (3,) unit vector.
    """
    lengths, centers = open_rims(mesh)
    if not len(lengths):
        return 0, 0.0
    heights = mesh.vertices[np.unique(mesh.faces)].astype(np.float64) @ up
    longest = int(lengths.argmax())
    level = (float(centers[longest] @ up) - heights.min()) / max(float(np.ptp(heights)), 1e-12)
    if level < _LOW:
        lengths = np.delete(lengths, longest)
    return len(lengths), float(lengths.sum())


def loose_parts(mesh: TriangleMesh) -> tuple[int, float]:
    """How many small pieces of the surface hang together with nothing, and their share of it."""
    _, _, areas = _pieces(mesh)
    total = float(areas.sum())
    small = areas[(areas > 0) & (areas < _BIT * total)]
    return len(small), float(small.sum()) / total if total else 0.0


def hanging_share(mesh: TriangleMesh, normal: F64) -> float:
    """The share of the surface in large pieces that nothing holds: what holds them is missing.

    A piece is held if it ends as low as the lowest one, or touches another that is held.

    Args:
        normal: (3,) of the ground, unit, upwards.
    """
    from scipy.sparse.csgraph import connected_components

    points, faces, areas = _pieces(mesh)
    total = float(areas.sum())
    large = np.flatnonzero(areas >= _BIT * total)
    if len(large) < 2:
        return 0.0
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    parts = [points[np.unique(faces[label])] for label in large.tolist()]
    ends = np.array([np.quantile(part @ normal, _STRAY) for part in parts])
    touch = np.eye(len(parts), dtype=bool)
    for j, label in enumerate(large.tolist()):
        for i, part in enumerate(parts):
            some = part[:: -(-len(part) // _TRIED)]
            touch[i, j] |= _gap(some, points, faces[label]) < _TOUCHES * diagonal
    _, group = connected_components(touch, directed=False)
    held = np.isin(group, group[ends < ends.min() + _STANDS * diagonal])
    return float(areas[large][~held].sum()) / total


def height_above(mesh: TriangleMesh, normal: F64) -> float:
    """How far the mesh ends above the plane through the world's origin, in its diagonals.

    Args:
        normal: (3,) of the plane, unit, upwards.
    """
    points, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    if not len(faces):
        return 0.0
    areas = _areas(points, faces)
    heights = points[faces].mean(1) @ normal
    order = np.argsort(heights)
    below = np.cumsum(areas[order])
    lowest = heights[order][np.searchsorted(below, _STRAY * below[-1])]
    diagonal = float(np.linalg.norm(np.ptp(points[np.unique(faces)], axis=0)))
    return max(0.0, float(lowest)) / max(diagonal, 1e-30)


def seen_shares(textured: TexturedMesh) -> tuple[float, float]:
    """The shares of the surface whose shape is well known, and that no photo saw."""
    mesh, size = textured.mesh, textured.size
    middle = mesh.uv[mesh.faces].mean(1)
    column, row = np.clip(middle * size, 0, size - 1).astype(np.int64).T
    trust = textured.confidence[row, column] / 65535
    areas = _areas(mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64))
    total = max(float(areas.sum()), 1e-30)
    return float(areas[trust >= WELL].sum()) / total, float(areas[trust == 0].sum()) / total


def confidence_at(textured: TexturedMesh, points: F64) -> F64:
    """(N,) the confidence, 0 to 1, at the places of the mesh that are nearest to points (N, 3)."""
    mesh, size = textured.mesh, textured.size
    face, weights = Solid(mesh.vertices, mesh.faces).nearest(points.astype(np.float32))
    uv = at_hits(mesh.uv, mesh.faces, face, weights)
    column, row = np.clip(uv * size, 0, size - 1).astype(np.int64).T
    return np.asarray(textured.confidence[row, column] / 65535)


def _gap(places: F64, points: F64, faces: Ints) -> float:
    """The least distance of places (N, 3) to a mesh of points (P, 3) and faces (F, 3)."""
    vertices, corners = points.astype(np.float32), faces.astype(np.int32)
    face, weights = Solid(vertices, corners).nearest(places.astype(np.float32))
    return float(np.linalg.norm(at_hits(vertices, corners, face, weights) - places, axis=1).min())


def _pieces(mesh: TriangleMesh) -> tuple[F64, list[Ints], F64]:
    """(P, 3) places of vertices; the faces (F, 3) of each connected piece, and its area."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    points, faces = _welded(mesh)
    start, end = faces[:, [0, 1]].reshape(-1), faces[:, [1, 2]].reshape(-1)
    links = coo_array((np.ones(len(start)), (start, end)), shape=(len(points),) * 2)
    count, labels = connected_components(links, directed=False)
    of = labels[faces[:, 0]]
    areas = np.bincount(of, _areas(points, faces), count).astype(np.float64)
    order = np.argsort(of, kind="stable")
    return points, np.split(faces[order], np.cumsum(np.bincount(of, minlength=count))[:-1]), areas


def _welded(mesh: TriangleMesh | UvMesh) -> tuple[F64, Ints]:
    """(P, 3) distinct places of vertices, and (F, 3) faces between them."""
    points, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    return points.astype(np.float64), same.reshape(-1)[mesh.faces]


def _areas(points: F64, faces: Ints) -> F64:
    a, b, c = (points[faces[:, i]] for i in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
