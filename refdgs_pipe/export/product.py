"""The textured object as every format wants it: +Y up, metres, 8-bit pictures."""

from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.export.about import About
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.vectors import unit

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

_JPEG_QUALITY = 95


@dataclass(frozen=True)
class Product:
    """A mesh in metres with +Y up, and its pictures, row 0 at v = 0 (top).

    Args:
        vertices, normals: (V, 3) float32; tangents: (V, 4); uv: (V, 2), v down; faces: (F, 3).
        base_color: (S, S, 3) sRGB; roughness, metallic, occlusion: (S, S) linear;
        normal: (S, S, 3), green up.
        confidence: (S, S) linear; 0 where no camera saw the surface, and only there.
        is_open: some edge has a face on one side only, so the inside can be seen.
        about: what the files say about themselves; see `about_asset`.
    """

    vertices: F32
    normals: F32
    tangents: F32
    uv: F32
    faces: NDArray[np.int32]
    base_color: U8
    roughness: U8
    metallic: U8
    occlusion: U8
    normal: U8
    confidence: U8
    is_open: bool
    about: About = field(default_factory=dict)

    @property
    def has_metal(self) -> bool:
        """Whether any of it is metal."""
        return bool(self.metallic.any())


def product(
    textured: TexturedMesh, *, up: F64, metres_per_unit: float, about: About | None = None
) -> Product:
    """Turn a textured mesh to +Y up and metres.

    Args:
        up: (3,) the world's up vector.
        about: what the files are to say about themselves.
    """
    frame = AssetFrame.of(up, metres_per_unit)
    mesh = textured.mesh
    tangents = unit(frame.directions(textured.tangents[:, :3])).astype(np.float32)
    return Product(
        vertices=frame.points(mesh.vertices).astype(np.float32),
        normals=unit(frame.directions(mesh.normals)).astype(np.float32),
        tangents=np.concatenate([tangents, textured.tangents[:, 3:]], axis=1),
        uv=np.clip(mesh.uv, 0, 1),
        faces=mesh.faces,
        base_color=_eight_bits(textured.base_color),
        roughness=_eight_bits(textured.roughness),
        metallic=_eight_bits(textured.metallic),
        occlusion=_eight_bits(textured.occlusion),
        normal=_eight_bits(textured.normal),
        confidence=np.maximum(_eight_bits(textured.confidence), textured.confidence > 0),
        is_open=_is_open(mesh.vertices, mesh.faces),
        about=about or {},
    )


def scale_of(
    mesh: UvMesh, *, known: float | None, longest: float | None
) -> tuple[float, Literal["given", "known from the capture", "unknown"]]:
    """How many metres a world unit is, and what tells it; one where nothing does.

    Args:
        known: what the capture told, if anything did.
        longest: the longest side of the object's box in metres, if the user said; it wins.
    """
    if longest is not None:
        return longest / float(np.ptp(mesh.vertices, axis=0).max()), "given"
    return (1.0, "unknown") if known is None else (known, "known from the capture")


def told_size(mesh: UvMesh, metres_per_unit: float, told: str) -> str:
    """The longest side of the object's box in metres, and what tells it, in words."""
    longest = metres_per_unit * float(np.ptp(mesh.vertices, axis=0).max())
    if told == "unknown":
        return f"unknown: exported {longest:.3g} m long. Give --size METRES, or use a mat"
    return f"{longest:.4g} m, {told}"


def jpeg(pixels: U8) -> bytes:
    """A colour picture (H, W, 3) as JPEG, without chroma subsampling."""
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return cv2.imencode(".jpg", pixels[..., ::-1], options)[1].tobytes()


def png(pixels: U8) -> bytes:
    """A picture (H, W) or (H, W, 3) as PNG."""
    picture = pixels if pixels.ndim == 2 else pixels[..., ::-1]
    return cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 6])[1].tobytes()


def _eight_bits(pixels: NDArray[np.uint16]) -> U8:
    return np.asarray((pixels.astype(np.uint32) + 128) // 257, np.uint8)


def _is_open(vertices: F32, faces: NDArray[np.int32]) -> bool:
    """Whether an edge has one face only; vertices that a seam repeats count as one."""
    _, same = np.unique(vertices, axis=0, return_inverse=True)
    welded = same.reshape(-1)[faces]
    edges = np.sort(np.stack([welded, np.roll(welded, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    return bool((np.unique(edges, axis=0, return_counts=True)[1] == 1).any())
