"""glTF 2.0 in one binary file (GLB): metallic-roughness, tangents, nothing but the core."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.export.product import Product, jpeg, png

_COMPONENTS = {"f4": 5126, "u4": 5125, "u2": 5123, "i2": 5122, "u1": 5121, "i1": 5120}
VERTICES, INDICES = 34962, 34963  # bufferView.target
_CLAMP, _LINEAR, _MIPMAPS = 33071, 9729, 9987


def write_glb(path: Path, product: Product, *, generator: str) -> None:
    """Write the product as a GLB; what it is to say about itself goes to `asset.extras`.

    Args:
        generator: the tool and its version.
    """
    chunk = Chunk()
    indices = product.faces.reshape(-1)
    is_small = len(product.vertices) < 65535
    attributes = {
        "POSITION": chunk.accessor(product.vertices, "VEC3", VERTICES, bounds=True),
        "NORMAL": chunk.accessor(product.normals, "VEC3", VERTICES),
        "TANGENT": chunk.accessor(product.tangents, "VEC4", VERTICES),
        "TEXCOORD_0": chunk.accessor(product.uv, "VEC2", VERTICES),
    }
    faces = chunk.accessor(indices.astype(np.uint16 if is_small else np.uint32), "SCALAR", INDICES)
    packed = np.stack([product.occlusion, product.roughness, product.metallic], -1)
    images = [
        chunk.image("base_color", jpeg(product.base_color), "image/jpeg"),
        chunk.image("occlusion_roughness_metallic", png(packed), "image/png"),
        chunk.image("normal", png(product.normal), "image/png"),
    ]
    primitive = {"attributes": attributes, "indices": faces, "material": 0, "mode": 4}
    save_glb(path, document_of(product, chunk, primitive, images, generator=generator), chunk)


def document_of(
    product: Product,
    chunk: "Chunk",
    primitive: dict[str, Any],
    images: list[dict[str, Any]],
    *,
    generator: str,
) -> dict[str, Any]:
    """The JSON of one mesh with one material.

    Args:
        images: base colour; occlusion, roughness and metal; normals.
    """
    return {
        "asset": {"version": "2.0", "generator": generator, "extras": product.about},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "object", "mesh": 0}],
        "meshes": [{"name": "object", "primitives": [primitive]}],
        "materials": [_material(product)],
        "textures": [{"sampler": 0, "source": i} for i in range(len(images))],
        "samplers": [
            {"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}
        ],
        "images": images,
        "accessors": chunk.accessors,
        "bufferViews": chunk.views,
        "buffers": [{"byteLength": len(chunk.data)}],
    }


def save_glb(path: Path, document: dict[str, Any], chunk: "Chunk") -> None:
    """Write a document and its binary chunk as one file."""
    text = json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(chunk.data)
    with path.open("wb") as file:
        file.write(struct.pack("<4sII", b"glTF", 2, total))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", len(chunk.data), b"BIN\0") + chunk.data)


def _material(product: Product) -> dict[str, Any]:
    return {
        "name": "surface",
        "doubleSided": product.is_open,
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicRoughnessTexture": {"index": 1},
            "metallicFactor": 1.0,
            "roughnessFactor": 1.0,
        },
        "normalTexture": {"index": 2},
        "occlusionTexture": {"index": 1},
    }


class Chunk:
    """The binary chunk while it grows. Every view starts at a multiple of four bytes."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def _view(self, content: bytes, **more: Any) -> int:
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content), **more}
        self.views.append(view)
        self.data += content + b"\0" * (-len(content) % 4)
        return len(self.views) - 1

    def accessor(
        self,
        values: NDArray[Any],
        kind: str,
        target: int,
        *,
        bounds: bool = False,
        normalized: bool = False,
    ) -> int:
        """Add rows of numbers; rows that are no multiple of four bytes are padded.

        Args:
            normalized: whole numbers stand for fractions (KHR_mesh_quantization).
        """
        rows = np.ascontiguousarray(values)
        size = rows[0].nbytes if target == VERTICES else 0
        more: dict[str, Any] = {"target": target}
        content = rows.tobytes()
        if size % 4:
            stride = size + -size % 4
            padded = np.zeros((len(rows), stride), np.uint8)
            padded[:, :size] = rows.view(np.uint8).reshape(len(rows), size)
            content, more["byteStride"] = padded.tobytes(), stride
        record: dict[str, Any] = {
            "bufferView": self._view(content, **more),
            "componentType": _COMPONENTS[values.dtype.str[1:]],
            "count": len(values),
            "type": kind,
        }
        if normalized:
            record["normalized"] = True
        if bounds:
            number = float if values.dtype.kind == "f" else int
            record["min"] = [number(x) for x in values.min(0)]
            record["max"] = [number(x) for x in values.max(0)]
        self.accessors.append(record)
        return len(self.accessors) - 1

    def image(self, name: str, content: bytes, mime: str) -> dict[str, Any]:
        """Add an image file; what the document says of it is returned."""
        return {"name": name, "mimeType": mime, "bufferView": self._view(content)}
