"""From a fused mesh to one clean surface within a face budget."""

import threading
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.child_process import call_in_child
from refdgs_pipe.errors import MeshError
from refdgs_pipe.surface.topology import (
    Rim,
    compacted,
    face_areas,
    made_manifold,
    pieces,
    rims,
)

_TIMEOUT_S = 1800.0


@dataclass(frozen=True)
class Removed:
    """The floaters that were taken away: how many, their faces, and their share of the area."""

    pieces: int
    faces: int
    area_share: float


@dataclass(frozen=True)
class Cleaned:
    """A clean mesh, what was removed for it, and the rims that stay open, longest first."""

    mesh: TriangleMesh
    removed: Removed
    rims: list[Rim]

    def figures(self) -> list[tuple[str, float, str]]:
        """What to tell of it: name, value, unit."""
        return [
            ("faces", len(self.mesh.faces), ""),
            ("floaters removed", self.removed.pieces, ""),
            ("floaters' share of the area", round(self.removed.area_share, 4), ""),
            ("open rims", len(self.rims), ""),
            ("open area", round(sum(r.area for r in self.rims), 4), "square world units"),
        ]


def clean(
    raw: TriangleMesh,
    *,
    floater: float,
    hole: float,
    smoothing: int,
    faces: int,
    base: NDArray[np.float64] | None = None,
    stop: threading.Event | None = None,
) -> Cleaned:
    """Remove floaters, repair, close small holes, smooth and simplify.

    Args:
        floater: pieces with a smaller bounding diagonal go, world units; the largest stays.
        hole: rims up to this length are closed, world units.
        smoothing: Taubin steps.
        faces: the budget.
        base: (3,) unit normal of the plane through the origin, to close what is open on it.

    Raises:
        MeshError: nothing is left.
        ChildCrashed: the mesh library died.
    """
    solid, removed = without_floaters(raw, floater)
    vertices, triangles = call_in_child(
        "refdgs_pipe.surface.cleanup:repair_and_simplify",
        {
            "vertices": solid.vertices,
            "faces": solid.faces,
            "hole": hole,
            "smoothing": smoothing,
            "target": faces,
            "base": np.zeros(3) if base is None else base,
        },
        timeout_s=_TIMEOUT_S,
        stop=stop,
    )
    mesh = made_manifold(compacted(vertices, triangles))
    mesh, _ = without_floaters(mesh, floater)
    return Cleaned(mesh, removed, rims(mesh))


def without_floaters(mesh: TriangleMesh, diagonal: float) -> tuple[TriangleMesh, Removed]:
    """The mesh without the pieces whose bounding diagonal is shorter; the largest always stays.

    Raises:
        MeshError: there was nothing to begin with.
    """
    mesh = compacted(mesh.vertices, mesh.faces)
    if not len(mesh.faces):
        raise MeshError("the mesh has no face with an area: look at the fused mesh (extract)")
    piece = pieces(mesh)
    count = int(piece.max()) + 1
    corners = mesh.vertices[mesh.faces]
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, piece, corners.min(1))
    np.maximum.at(high, piece, corners.max(1))
    areas = face_areas(mesh.vertices, mesh.faces)
    keep = np.linalg.norm(high - low, axis=1) >= diagonal
    keep[np.bincount(piece, areas).argmax()] = True
    kept = keep[piece]
    share = float(areas[~kept].sum() / areas.sum())
    removed = Removed(int((~keep).sum()), int((~kept).sum()), share)
    return compacted(mesh.vertices, mesh.faces[kept]), removed


def repair_and_simplify(
    vertices: NDArray[np.float32],
    faces: NDArray[np.int32],
    hole: float,
    smoothing: int,
    target: int,
    base: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Repaired, closed, smoothed and decimated (V, 3) vertices and (F, 3) faces.

    Args:
        base: (3,) normal of the plane through the origin on which all holes are closed; 0 for none.

    Runs in a child process: the library keeps global state and may crash.
    """
    import pymeshlab

    meshes = pymeshlab.MeshSet(verbose=False)
    edge = float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))
    points = vertices.astype(np.float64)
    meshes.add_mesh(pymeshlab.Mesh(_uneven(points, base, edge) if base.any() else points, faces))
    _repair(meshes)
    edges = int(hole / edge)
    if edges >= 3:
        # Left selected, the new faces would be all that the later filters work on.
        meshes.meshing_close_holes(maxholesize=edges, newfaceselected=False)
        _repair(meshes)
    if base.any():
        _close_base(meshes, base, edge)
    if smoothing:
        meshes.apply_coord_taubin_smoothing(lambda_=0.5, mu=-0.53, stepsmoothnum=smoothing)
    if meshes.current_mesh().face_number() > target:
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=target,
            qualitythr=0.5,
            preserveboundary=True,
            preservenormal=True,
            preservetopology=True,
            optimalplacement=True,
            planarquadric=True,
        )
        _repair(meshes)
    mesh = meshes.current_mesh()
    return mesh.vertex_matrix(), mesh.face_matrix()


def _uneven(
    points: NDArray[np.float64], base: NDArray[np.float64], edge: float
) -> NDArray[np.float64]:
    """The vertices, those on the base moved in it by up to a twentieth of an edge.

    The rim runs along rows of voxels. Places in one line would be joined by faces without an area.
    """
    away = np.random.default_rng(0).uniform(-0.05, 0.05, points.shape) * edge
    away -= (away @ base)[:, None] * base
    on = np.abs(points @ base) < edge / 4
    return np.where(on[:, None], points + away, points)


def _close_base(meshes: Any, base: NDArray[np.float64], edge: float) -> None:
    """Close all holes beside faces that lie on the plane through the origin."""
    x, y, z = base
    on = f"abs(({x})*x+({y})*y+({z})*z)<{edge / 4}"
    meshes.compute_selection_by_condition_per_vertex(condselect=on)
    meshes.compute_selection_transfer_vertex_to_face(inclusive=False)
    longest = meshes.current_mesh().vertex_number()
    # The library's test whether new faces cross others leaves a ragged rim open.
    meshes.meshing_close_holes(
        maxholesize=longest, selected=True, newfaceselected=False, selfintersection=False
    )
    meshes.set_selection_none()
    _repair(meshes)


def _repair(meshes: Any) -> None:
    meshes.meshing_remove_duplicate_vertices()
    meshes.meshing_remove_duplicate_faces()
    meshes.meshing_remove_null_faces()
    meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
    meshes.meshing_repair_non_manifold_vertices(vertdispratio=0)
    meshes.meshing_remove_unreferenced_vertices()
