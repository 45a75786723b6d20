"""A mesh with its textures."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.errors import CorruptError, ShapeError
from refdgs_pipe.files.ply import read_ply, write_ply

U16 = NDArray[np.uint16]
_COLOR_SPACES = {
    "base_color": "sRGB",
    "roughness": "linear",
    "metallic": "linear",
    "occlusion": "linear",
    "normal": "linear, tangent space, n * 0.5 + 0.5, green up (glTF)",
    "confidence": "linear",
}


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh and square textures of one power-of-two size S, 16 bits a channel.

    Args:
        mesh: texel (row, column) has its centre at uv ((column + 0.5) / S, (row + 0.5) / S).
        tangents: (V, 4) MikkTSpace tangents and the sign of the bitangent, for green up.
        base_color: (S, S, 3) sRGB-encoded: diffuse colour, or the reflectance of metals.
        roughness: (S, S) linear; square root of the GGX alpha, as in glTF and USD.
        metallic: (S, S) linear.
        occlusion: (S, S) linear; 1 where nothing of the object is in front of the surface.
        normal: (S, S, 3) tangent space, n * 0.5 + 0.5.
        confidence: (S, S) linear; how certain the shape is (`texture.trust`); 0 where no camera saw
            the surface and colours are filled in.
    """

    mesh: UvMesh
    tangents: NDArray[np.float32]
    base_color: U16
    roughness: U16
    metallic: U16
    occlusion: U16
    normal: U16
    confidence: U16

    def __post_init__(self) -> None:
        size = self.size
        if size & (size - 1) or not size:
            raise ShapeError(f"textures are {size} texels wide: use a power of two")
        for name in _COLOR_SPACES:
            shape = getattr(self, name).shape
            if shape[:2] != (size, size):
                raise ShapeError(f"{name} is {shape} but base_color is {size} wide")
        if self.tangents.shape != (len(self.mesh.vertices), 4):
            raise ShapeError(f"tangents are {self.tangents.shape}: one per vertex, 4 wide")

    @property
    def size(self) -> int:
        """Texels along a side."""
        return len(self.base_color)

    def save(self, folder: Path) -> None:
        from refdgs_pipe.files.images import write_png

        mesh = self.mesh
        tables = (mesh.vertices, mesh.normals, mesh.uv, self.tangents)
        columns = dict(zip(_COLUMNS, np.concatenate(tables, axis=1).T, strict=True))
        write_ply(folder / "mesh.ply", columns, mesh.faces)
        for name in _COLOR_SPACES:
            write_png(folder / f"{name}.png", getattr(self, name))
        (folder / "textures.json").write_text(json.dumps({"color_spaces": _COLOR_SPACES}, indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        from refdgs_pipe.files.images import read_png

        ply = read_ply(folder / "mesh.ply")
        if ply.faces is None or any(name not in ply.columns for name in _COLUMNS):
            raise CorruptError("mesh.ply: not the mesh of a textured mesh")
        table = np.stack([ply.columns[name] for name in _COLUMNS], -1).astype(np.float32)
        mesh = UvMesh(table[:, 0:3], table[:, 3:6], table[:, 6:8], ply.faces)
        textures = {}
        for name in _COLOR_SPACES:
            pixels = read_png(folder / f"{name}.png")
            if pixels.dtype != np.uint16:
                raise CorruptError(f"{name}.png: {pixels.dtype} samples, expected 16 bits")
            textures[name] = pixels.astype(np.uint16)
        return cls(mesh, table[:, 8:12], **textures)


_COLUMNS = ("x", "y", "z", "nx", "ny", "nz", "s", "t", "tx", "ty", "tz", "tw")
