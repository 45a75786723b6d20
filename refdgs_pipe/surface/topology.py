"""How a mesh hangs together: pieces, rims, and the split that makes it manifold."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from refdgs_pipe.artifacts.mesh import TriangleMesh

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Defects:
    """What keeps a mesh from being a clean oriented surface; all zero for a good one.

    Args:
        degenerate: faces without area or with a repeated corner.
        edges: edges with more than two faces, or two that disagree on the orientation.
        vertices: vertices where separate fans of faces touch.
        loose: vertices that no face uses.
    """

    degenerate: int
    edges: int
    vertices: int
    loose: int

    @property
    def any(self) -> bool:
        return bool(self.degenerate or self.edges or self.vertices or self.loose)


@dataclass(frozen=True)
class Rim:
    """A closed line of edges with a face on one side only.

    Args:
        length: world units.
        area: of a fan from its centre, square world units.
        center: (3,) world.
    """

    length: float
    area: float
    center: F64


def face_areas(vertices: NDArray[np.floating], faces: NDArray[np.integer]) -> F64:
    """(F,) areas."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def pieces(mesh: TriangleMesh) -> Ints:
    """(F,) the number of the connected piece that each face belongs to, from 0."""
    n = len(mesh.vertices)
    start = mesh.faces[:, [0, 1]].reshape(-1)
    end = mesh.faces[:, [1, 2]].reshape(-1)
    graph = coo_array((np.ones(len(start), bool), (start, end)), shape=(n, n))
    _, labels = connected_components(graph, directed=False)
    _, dense = np.unique(labels[mesh.faces[:, 0]], return_inverse=True)
    return np.asarray(dense, np.int64)


def compacted(vertices: F64 | NDArray[np.float32], faces: NDArray[np.integer]) -> TriangleMesh:
    """The mesh without degenerate or repeated faces and without vertices that no face uses."""
    faces = faces[face_areas(vertices, faces) > 0]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(first)]
    used, renumbered = np.unique(faces, return_inverse=True)
    return TriangleMesh(
        vertices[used].astype(np.float32), renumbered.reshape(-1, 3).astype(np.int32)
    )


def defects(mesh: TriangleMesh) -> Defects:
    """Count what is wrong with a mesh."""
    matched, surplus = _edges(mesh.faces)
    fans = _fans(mesh.faces, matched)
    pairs = np.unique(np.stack([mesh.faces.reshape(-1), fans], 1), axis=0)
    used = len(np.unique(mesh.faces))
    return Defects(
        degenerate=int((face_areas(mesh.vertices, mesh.faces) <= 0).sum()),
        edges=len(surplus),
        vertices=len(pairs) - used,
        loose=len(mesh.vertices) - used,
    )


def made_manifold(mesh: TriangleMesh) -> TriangleMesh:
    """The same surface with its vertices split, and if need be faces dropped, until it is manifold.

    Every fan of faces around a vertex that hangs together by properly shared edges gets a vertex
    of its own. What a split cannot cure loses the smaller of its faces.
    """
    mesh = compacted(mesh.vertices, mesh.faces)
    while True:
        matched, _ = _edges(mesh.faces)
        corners = mesh.faces.reshape(-1)
        _, first, fan = np.unique(
            _fans(mesh.faces, matched), return_index=True, return_inverse=True
        )
        mesh = compacted(mesh.vertices[corners[first]], fan.reshape(-1, 3))
        _, surplus = _edges(mesh.faces)
        if not len(surplus):
            return mesh
        areas = face_areas(mesh.vertices, mesh.faces)
        worst = {min(face_group, key=lambda f: areas[f]) for face_group in surplus}
        mesh = compacted(mesh.vertices, np.delete(mesh.faces, list(worst), axis=0))


def rims(mesh: TriangleMesh) -> list[Rim]:
    """The open rims of a manifold mesh, longest first."""
    edges = _directed(mesh.faces)
    twins = np.unique(np.sort(edges, 1), axis=0, return_inverse=True, return_counts=True)
    border = edges[(twins[2] == 1)[twins[1]]]
    if not len(border):
        return []
    n = len(mesh.vertices)
    graph = coo_array((np.ones(len(border), bool), (border[:, 0], border[:, 1])), shape=(n, n))
    _, labels = connected_components(graph, directed=False)
    found = []
    for label in np.unique(labels[border[:, 0]]):
        loop = border[labels[border[:, 0]] == label]
        start, end = (mesh.vertices[loop[:, i]].astype(np.float64) for i in range(2))
        center = start.mean(0)
        fan = np.cross(start - center, end - center).sum(0) / 2
        length = float(np.linalg.norm(end - start, axis=1).sum())
        found.append(Rim(length, float(np.linalg.norm(fan)), center))
    return sorted(found, key=lambda rim: -rim.length)


def _directed(faces: NDArray[np.integer]) -> Ints:
    """(3F, 2) edges; edge 3f + i runs from corner i of face f to the next."""
    return np.stack([faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)], 1).astype(np.int64)


def _edges(faces: NDArray[np.integer]) -> tuple[Ints, list[Ints]]:
    """Pairs (M, 2) of directed edges that are each other's opposite, and the faces of bad edges."""
    edges = _directed(faces)
    order = np.lexsort(np.sort(edges, 1).T)
    sorted_edges = np.sort(edges[order], 1)
    starts = np.flatnonzero(np.r_[True, (np.diff(sorted_edges, axis=0) != 0).any(1)])
    counts = np.diff(np.r_[starts, len(edges)])
    two = starts[counts == 2]
    pairs = np.stack([order[two], order[two + 1]], 1)
    opposite = edges[pairs[:, 0], 0] == edges[pairs[:, 1], 1]
    surplus = [pair // 3 for pair in pairs[~opposite]]
    for start, count in zip(starts[counts > 2], counts[counts > 2], strict=True):
        surplus.append(order[start : start + count] // 3)
    return pairs[opposite], surplus


def _fans(faces: NDArray[np.integer], matched: Ints) -> Ints:
    """(3F,) the fan that each corner belongs to: corners joined across properly shared edges."""
    corner = np.arange(3 * len(faces)).reshape(-1, 3)
    after = np.roll(corner, -1, axis=1).reshape(-1)
    a, b = matched.T
    joins = np.r_[np.stack([a, after[b]], 1), np.stack([after[a], b], 1)]
    size = corner.size
    graph = coo_array((np.ones(len(joins), bool), (joins[:, 0], joins[:, 1])), shape=(size, size))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)
