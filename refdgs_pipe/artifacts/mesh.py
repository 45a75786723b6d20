"""Triangle meshes. Distinct types because they promise different things."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.files.obj import read_obj
from refdgs_pipe.files.ply import read_mesh, write_mesh

_LEAST_COMMON = 0.25  # of the boxes' union: a mesh may be cut, but not turned or scaled


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


@dataclass(frozen=True)
class CleanMesh(TriangleMesh):
    """One manifold, consistently oriented surface, not yet fitted to the photos.

    Args:
        budget: the most triangles that the fitted mesh may have.
    """

    budget: int

    def save(self, folder: Path) -> None:
        super().save(folder)
        (folder / "clean.json").write_text(json.dumps({"budget": self.budget}), "utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: a file is missing or damaged.
        """
        data = read_mesh(folder / "mesh.ply")
        try:
            budget = int(json.loads((folder / "clean.json").read_text("utf-8"))["budget"])
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise CorruptError(
                f"{folder}: not a readable mesh ({error}): run the stage clean again"
            ) from error
        return cls(data.vertices, data.faces, budget)


class Mesh(TriangleMesh):
    """The final surface: manifold, consistently oriented, fitted to the photos."""

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

    def placed_like(self, before: "Mesh") -> None:
        """Refuse an adopted mesh that does not lie where the one that it replaces does.

        Exported files are in metres and +Y up; the pipeline's own meshes are in world units.

        Raises:
            InputError: the boxes round both hardly overlap.
        """
        own, old = _box(self), _box(before)
        common = np.prod(np.clip(np.minimum(own[1], old[1]) - np.maximum(own[0], old[0]), 0, None))
        whole = np.prod(own[1] - own[0]) + np.prod(old[1] - old[0]) - common
        if common < _LEAST_COMMON * whole:
            shown = (np.array2string(np.concatenate(box), precision=3) for box in (own, old))
            raise InputError(
                "the mesh lies elsewhere: from and to {}, expected {}. Exported files are in "
                "metres and +Y up: edit mesh.ply of the folder that `refdgs-pipe path WORKSPACE "
                "mesh` prints, and save it without turning or scaling it".format(*shown)
            )


def _box(mesh: TriangleMesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The least and the largest coordinates, of a box that is nowhere flat."""
    low, high = mesh.vertices.min(0).astype(float), mesh.vertices.max(0).astype(float)
    thin = 1e-3 * max(float((high - low).max()), 1e-12)
    return low - thin, high + thin


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
