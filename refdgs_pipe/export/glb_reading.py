"""What a GLB of ours holds, read back from its bytes."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.errors import ExportError
from refdgs_pipe.export.product import Product
from refdgs_pipe.vectors import unit

BYTE = 5120
_WIDTHS = {
    **{BYTE: ("i1", 1), 5121: ("u1", 1), 5122: ("<i2", 2), 5123: ("<u2", 2)},
    **{5125: ("<u4", 4), 5126: ("<f4", 4)},
}
_KINDS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk.

    Raises:
        ValueError: the file is not built as a GLB is.
    """
    magic, version, total = struct.unpack_from("<4sII", data)
    if magic != b"glTF" or version != 2 or total != len(data):
        raise ValueError(f"header says {total} bytes of version {version}, file has {len(data)}")
    length, kind = struct.unpack_from("<I4s", data, 12)
    if kind != b"JSON" or length % 4:
        raise ValueError("the first chunk is not aligned JSON")
    document = json.loads(data[20 : 20 + length])
    size, kind = struct.unpack_from("<I4s", data, 20 + length)
    binary = data[28 + length :]
    if kind != b"BIN\0" or size % 4 or size != len(binary):
        raise ValueError("the second chunk is not the aligned rest of the file")
    return document, binary


def view_of(document: dict[str, Any], binary: bytes, index: int) -> bytes:
    """The bytes of a bufferView."""
    view = document["bufferViews"][index]
    return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]


def stored_array(document: dict[str, Any], binary: bytes, index: int) -> NDArray[Any]:
    """(N,) or (N, C) numbers of an accessor, as they are stored.

    Raises:
        ValueError: the view does not hold what the accessor says.
    """
    record = document["accessors"][index]
    dtype, width = _WIDTHS[record["componentType"]]
    view = document["bufferViews"][record["bufferView"]]
    columns = _KINDS[record["type"]]
    if view["byteOffset"] % width:
        raise ValueError(f"accessor {index} is not aligned")
    data = np.frombuffer(view_of(document, binary, record["bufferView"]), dtype)
    stride = view.get("byteStride", columns * width) // width
    if len(data) != record["count"] * stride:
        raise ValueError(f"accessor {index} says {record['count']} rows, its view holds others")
    return data.reshape(-1, stride)[:, :columns] if columns > 1 else data


def array_of(document: dict[str, Any], binary: bytes, index: int) -> NDArray[Any]:
    """The same, whole numbers as the fractions that they stand for (glTF 2.0, section 3.6.2.2).

    Raises:
        ValueError: the view does not hold what the accessor says.
    """
    stored = stored_array(document, binary, index)
    if not document["accessors"][index].get("normalized"):
        return stored
    most = np.iinfo(stored.dtype).max
    return np.asarray(np.maximum(stored.astype(np.float32) / np.float32(most), -1))


def source_of(texture: dict[str, Any]) -> int:
    """The image of a texture."""
    webp = texture.get("extensions", {}).get("EXT_texture_webp", texture)
    return int(webp["source"])


def read_glb(path: Path, like: Product) -> Product:
    """The product that a viewer gets from a GLB of ours; `like` gives what the file has not.

    Raises:
        ExportError: it cannot be read.
    """
    try:
        document, binary = split_glb(path.read_bytes())
        ((primitive,),) = (mesh["primitives"] for mesh in document["meshes"])
        arrays = {k: array_of(document, binary, i) for k, i in primitive["attributes"].items()}
        indices = stored_array(document, binary, primitive["indices"])
        views = [document["images"][source_of(t)]["bufferView"] for t in document["textures"]]
        color, packed, normal = (_decoded(view_of(document, binary, view)) for view in views)
    except (OSError, ValueError, KeyError, IndexError, TypeError, struct.error) as error:
        raise ExportError(f"{path.name}: cannot be read back: {error}") from error
    node = document["nodes"][0]
    scale = np.float32(node.get("scale", [1.0])[0])
    moved = np.array(node.get("translation", [0.0, 0.0, 0.0]), np.float32)
    tangents = arrays["TANGENT"].astype(np.float32)
    return replace(
        like,
        vertices=arrays["POSITION"].astype(np.float32) * scale + moved,
        normals=unit(arrays["NORMAL"].astype(np.float32)),
        tangents=np.concatenate([unit(tangents[:, :3]), np.sign(tangents[:, 3:])], 1),
        uv=arrays["TEXCOORD_0"].astype(np.float32),
        faces=indices.reshape(-1, 3).astype(np.int32),
        base_color=color,
        occlusion=np.ascontiguousarray(packed[..., 0]),
        roughness=np.ascontiguousarray(packed[..., 1]),
        metallic=np.ascontiguousarray(packed[..., 2]),
        normal=normal,
    )


def _decoded(content: bytes) -> NDArray[np.uint8]:
    """(S, S, 3) of an image file."""
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError("an image cannot be decoded")
    return np.ascontiguousarray(picture[..., ::-1], np.uint8)
