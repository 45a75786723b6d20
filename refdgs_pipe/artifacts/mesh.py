"""Triangle meshes. Distinct types because they promise different things."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.files.obj import read_obj
from refdgs_pipe.files.ply import read_mesh, write_mesh


@dataclass(frozen=True)
class TriangleMesh:
    """Vertices (V, 3) float32 in world units and faces (F, 3) int32, counter-clockwise outside."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]

    def vertex_normals(self) -> NDArray[np.float32]:
        """(V, 3) unit normals, faces weighted by their area."""
        a, b, c = (self.vertices[self.faces[:, i]].astype(np.float64) for i in range(3))
        weighted = np.cross(b - a, c - a)
        total = np.zeros((len(self.vertices), 3))
        for i in range(3):
            np.add.at(total, self.faces[:, i], weighted)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        unit = np.where(length > 0, total / np.maximum(length, 1e-30), [0.0, 0.0, 1.0])
        return unit.astype(np.float32)

    def save(self, folder: Path) -> None:
        write_mesh(folder / "mesh.ply", self.vertices, self.faces)

    @classmethod
    def load(cls, folder: Path) -> Self:
        data = read_mesh(folder / "mesh.ply")
        return cls(data.vertices, data.faces)


class RawMesh(TriangleMesh):
    """As fused: dense, possibly with floaters and holes."""


class Mesh(TriangleMesh):
    """One clean, manifold, consistently oriented surface within the face budget."""

    @classmethod
    def adopt(cls, path: Path) -> Self:
        """A mesh that the user edited, in the frame of the one it replaces.

        Raises:
            InputError: not a PLY or OBJ file.
            CorruptError: it holds no triangles, or is broken.
        """
        readers = {".ply": read_mesh, ".obj": read_obj}
        if path.suffix.lower() not in readers:
            raise InputError(f"{path.name}: give the mesh as .ply or .obj")
        data = readers[path.suffix.lower()](path)
        if not len(data.faces):
            raise CorruptError(f"{path.name}: holds no triangles: adopt a mesh that has some")
        return cls(data.vertices, data.faces)


@dataclass(frozen=True)
class UvMesh:
    """A mesh cut along its charts.

    Args:
        vertices: (V, 3) float32, repeated along seams.
        normals: (V, 3) float32, unit, equal on both sides of a seam.
        uv: (V, 2) float32 in [0, 1]; v grows downwards in the image (glTF): row 0 is v = 0.
        faces: (F, 3) int32.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    uv: NDArray[np.float32]
    faces: NDArray[np.int32]

    def save(self, folder: Path) -> None:
        write_mesh(folder / "mesh.ply", self.vertices, self.faces, normals=self.normals, uv=self.uv)

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: the file is missing or damaged, or has no normals or texture coordinates.
        """
        data = read_mesh(folder / "mesh.ply")
        if data.normals is None or data.uv is None:
            raise CorruptError(f"{folder / 'mesh.ply'}: has no normals or no texture coordinates")
        return cls(data.vertices, data.normals, data.uv, data.faces)
