"""Coarser versions of a textured mesh, on the same textures."""

import tempfile
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.child_process import call_in_child
from refdgs_pipe.errors import MeshError
from refdgs_pipe.texture.charts import seam_split
from refdgs_pipe.texture.tangents import mikktspace

F32 = NDArray[np.float32]
Faces = NDArray[np.int32]
_TIMEOUT_S = 1800.0


@dataclass(frozen=True)
class Level:
    """A coarser version, and how far it is from the mesh that it was made of, world units.

    Args:
        mean, most: distance of both meshes' vertices to the other mesh; percentile_95: 95 % of
            them are nearer than this.
    """

    textured: TexturedMesh
    mean: float
    most: float
    percentile_95: float = 0.0

    def told(self, metres_per_unit: float) -> str:
        """The distances in words, metres."""
        mean, most = (metres_per_unit * length for length in (self.mean, self.most))
        return f"off by {mean:.3g} m in the mean, {most:.3g} m at most"


def levels(
    textured: TexturedMesh, budgets: Sequence[int], *, stop: threading.Event | None = None
) -> Iterator[Level]:
    """A level for each budget of faces; none for a budget that the mesh keeps as it is.

    Raises:
        MeshError: nothing is left.
        ChildCrashed: the mesh library died.
    """
    for budget in budgets:
        if budget < len(textured.mesh.faces):
            yield level(textured, budget, stop=stop)


def level(textured: TexturedMesh, budget: int, *, stop: threading.Event | None = None) -> Level:
    """The level of at most `budget` faces; the textured mesh itself where it has no more.

    Raises:
        MeshError: nothing is left.
        ChildCrashed: the mesh library died.
    """
    mesh = textured.mesh
    if budget >= len(mesh.faces):
        return Level(textured, 0.0, 0.0)
    vertices, faces, corners = call_in_child(
        "refdgs_pipe.texture.levels:simplified",
        {
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "corners": mesh.uv[mesh.faces],
            "target": budget,
        },
        timeout_s=_TIMEOUT_S,
        stop=stop,
    )
    if not len(faces):
        raise MeshError(f"no triangle is left of {len(mesh.faces)} for a level of {budget}")
    solid = Mesh(vertices.astype(np.float32), faces.astype(np.int32))
    split = seam_split(solid, np.clip(corners, 0, 1).astype(np.float32))
    apart = np.concatenate(
        [
            _distances(solid.vertices, mesh.vertices, mesh.faces),
            _distances(mesh.vertices, solid.vertices, solid.faces),
        ]
    )
    coarse = replace(textured, mesh=split, tangents=mikktspace(split))
    far = float(np.percentile(apart, 95))
    return Level(coarse, float(apart.mean()), float(apart.max()), far)


def simplified(
    vertices: F32, faces: Faces, corners: F32, target: int
) -> tuple[NDArray[np.float64], Faces, NDArray[np.float64]]:
    """(V, 3) vertices, (F, 3) faces and (F, 3, 2) texture coordinates of at most `target` faces.

    Runs in a child process: the library keeps global state and may crash.
    """
    import pymeshlab

    points, same = np.unique(vertices, axis=0, return_inverse=True)  # cuts closed again
    meshes = pymeshlab.MeshSet(verbose=False)
    with tempfile.TemporaryDirectory() as folder:
        _write_obj(Path(folder), points, same.reshape(-1)[faces].astype(np.int32), corners)
        meshes.load_new_mesh(str(Path(folder) / "mesh.obj"))
    meshes.meshing_decimation_quadric_edge_collapse_with_texture(
        targetfacenum=target,
        qualitythr=0.5,
        preserveboundary=True,
        preservenormal=True,
        planarquadric=True,
    )
    meshes.meshing_remove_null_faces()
    meshes.meshing_remove_unreferenced_vertices()
    mesh = meshes.current_mesh()
    coords = mesh.wedge_tex_coord_matrix().reshape(-1, 3, 2)
    return mesh.vertex_matrix(), mesh.face_matrix(), coords


def _write_obj(folder: Path, points: F32, faces: Faces, corners: F32) -> None:
    """A textured mesh: the library takes texture coordinates as such only from a file."""
    from refdgs_pipe.files.images import write_png

    write_png(folder / "texture.png", np.zeros((2, 2, 3), np.uint8))
    (folder / "mesh.mtl").write_text("newmtl surface\nmap_Kd texture.png\n")
    lines = ["mtllib mesh.mtl"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points.tolist()]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in corners.reshape(-1, 2).tolist()]
    lines.append("usemtl surface")
    lines += [
        f"f {a + 1}/{3 * i + 1} {b + 1}/{3 * i + 2} {c + 1}/{3 * i + 3}"
        for i, (a, b, c) in enumerate(faces.tolist())
    ]
    (folder / "mesh.obj").write_text("\n".join(lines) + "\n")


def _distances(points: F32, vertices: F32, faces: Faces) -> F32:
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(faces.astype(np.uint32))
    )
    return np.asarray(scene.compute_distance(o3d.core.Tensor.from_numpy(points)).numpy())
