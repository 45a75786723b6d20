"""Small meshes with known shape."""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh


def sphere(
    rings: int = 24, *, radius: float = 1.0, center: tuple[float, ...] = (0, 0, 0)
) -> TriangleMesh:
    """A closed sphere, counter-clockwise outside."""
    segments = 2 * rings
    polar = np.linspace(0, np.pi, rings + 1)[1:-1]
    turn = np.arange(segments) * 2 * np.pi / segments
    grid = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(turn),
            np.sin(polar)[:, None] * np.sin(turn),
            np.broadcast_to(np.cos(polar)[:, None], (rings - 1, segments)),
        ],
        -1,
    ).reshape(-1, 3)
    vertices = np.concatenate([[[0, 0, 1.0]], grid, [[0, 0, -1.0]]])
    last = len(vertices) - 1
    faces = []
    for j in range(segments):
        k = (j + 1) % segments
        faces.append((0, 1 + j, 1 + k))
        for i in range(rings - 2):
            a, b = 1 + i * segments + j, 1 + i * segments + k
            faces += [(a, a + segments, b), (b, a + segments, b + segments)]
        faces.append((last, last - segments + k, last - segments + j))
    scaled = vertices * radius + np.array(center)
    return TriangleMesh(scaled.astype(np.float32), np.array(faces, np.int32))


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    """Several meshes as one."""
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return TriangleMesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=False)]).astype(
            np.int32
        ),
    )


def volume(mesh: TriangleMesh) -> float:
    """Signed volume: positive when a closed mesh faces outwards."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def cube_corners() -> NDArray[np.float32]:
    """(8, 3) corners of the unit cube."""
    return np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)


def with_fin(mesh: TriangleMesh) -> TriangleMesh:
    """A third face on an edge."""
    tip = mesh.vertices[mesh.faces[100, :1]] * np.float32(1.3)
    fin = np.array([[*mesh.faces[100, :2], len(mesh.vertices)]], np.int32)
    return TriangleMesh(np.concatenate([mesh.vertices, tip]), np.concatenate([mesh.faces, fin]))


def with_flat_face(mesh: TriangleMesh) -> TriangleMesh:
    a, b, _ = mesh.faces[50]
    return TriangleMesh(
        mesh.vertices, np.concatenate([mesh.faces, np.array([[a, b, b]], np.int32)])
    )


def two_pieces(mesh: TriangleMesh) -> TriangleMesh:
    return joined(mesh, sphere(10, radius=0.3, center=(0, 0, 1.6)))


def touching_pieces(mesh: TriangleMesh) -> TriangleMesh:
    """Two balls that share one vertex."""
    both = joined(mesh, sphere(10, radius=0.3, center=(0, 0, 1.3)))
    lowest = len(both.vertices) - 1
    return TriangleMesh(both.vertices, np.where(both.faces == lowest, 0, both.faces))


def turned_face(mesh: TriangleMesh) -> TriangleMesh:
    """One face looks inwards."""
    faces = mesh.faces.copy()
    faces[200] = faces[200, ::-1]
    return TriangleMesh(mesh.vertices, faces)


def with_nan(mesh: TriangleMesh) -> TriangleMesh:
    vertices = mesh.vertices.copy()
    vertices[40] = np.nan
    return TriangleMesh(vertices, mesh.faces)
