"""Checks on written files, made on the bytes that the user will get."""

import json
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.errors import ExportError

_WIDTHS = {5121: ("u1", 1), 5123: ("<u2", 2), 5125: ("<u4", 4), 5126: ("<f4", 4)}
_KINDS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MAGIC = {"image/png": b"\x89PNG\r\n\x1a\n", "image/jpeg": b"\xff\xd8\xff"}
_UNIT = 2e-3  # how far from 1 a unit vector may be


def require(path: Path, faults: list[str]) -> None:
    """Stop an export whose file is not sound.

    Raises:
        ExportError: with the first faults.
    """
    if faults:
        shown = "; ".join(faults[:3])
        raise ExportError(
            f"{path.name} did not pass its check and is not published: {shown}. This is a bug in "
            "refdgs-pipe: please report it with the run's log"
        )


def glb_faults(path: Path) -> list[str]:
    """What is wrong with a GLB; empty for a sound one."""
    try:
        document, binary = _split_glb(path.read_bytes())
        return _document_faults(document, binary)
    except (ValueError, KeyError, IndexError, TypeError, struct.error) as error:
        return [f"structure: {error!r}"]


def _split_glb(data: bytes) -> tuple[dict[str, Any], bytes]:
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


def _document_faults(document: dict[str, Any], binary: bytes) -> list[str]:
    faults = []
    if document["buffers"][0]["byteLength"] > len(binary):
        faults.append("the buffer is longer than its chunk")
    for number, view in enumerate(document["bufferViews"]):
        if view["byteOffset"] + view["byteLength"] > len(binary):
            faults.append(f"bufferView {number} ends outside the buffer")
    for image in document["images"]:
        if not _view(document, binary, image["bufferView"]).startswith(_MAGIC[image["mimeType"]]):
            faults.append(f"image {image['name']} is not {image['mimeType']}")
    for texture in document["textures"]:
        if texture["source"] >= len(document["images"]):
            faults.append("a texture names an image that is not there")
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            faults += _primitive_faults(document, binary, primitive)
    return faults


def _primitive_faults(
    document: dict[str, Any], binary: bytes, primitive: dict[str, Any]
) -> list[str]:
    names = primitive["attributes"]
    arrays = {name: _array(document, binary, index) for name, index in names.items()}
    indices = _array(document, binary, primitive["indices"])
    count = len(arrays["POSITION"])
    faults = [
        f"{name} holds values that are not finite"
        for name, a in arrays.items()
        if not np.isfinite(a).all()
    ]
    faults += [
        f"{name} has {len(a)} rows, POSITION {count}"
        for name, a in arrays.items()
        if len(a) != count
    ]
    if not len(indices) or len(indices) % 3 or int(indices.max()) >= count:
        faults.append(f"{len(indices)} indices up to {indices.max(initial=0)}, {count} vertices")
    for name in ("NORMAL", "TANGENT"):
        length = np.linalg.norm(arrays[name][:, :3], axis=1)
        if np.abs(length - 1).max(initial=0) > _UNIT:
            faults.append(f"{name} is not unit length everywhere")
    if not np.isin(arrays["TANGENT"][:, 3], (-1, 1)).all():
        faults.append("TANGENT has a sign that is neither 1 nor -1")
    record = document["accessors"][names["POSITION"]]
    for key, bound in (("min", arrays["POSITION"].min(0)), ("max", arrays["POSITION"].max(0))):
        if not np.array_equal(np.array(record[key], np.float32), bound):
            faults.append(f"POSITION's {key} is not what the data says")
    return faults


def _view(document: dict[str, Any], binary: bytes, index: int) -> bytes:
    view = document["bufferViews"][index]
    return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]


def _array(document: dict[str, Any], binary: bytes, index: int) -> NDArray[Any]:
    record = document["accessors"][index]
    dtype, width = _WIDTHS[record["componentType"]]
    view = document["bufferViews"][record["bufferView"]]
    columns = _KINDS[record["type"]]
    if view["byteOffset"] % width:
        raise ValueError(f"accessor {index} is not aligned")
    data = np.frombuffer(_view(document, binary, record["bufferView"]), dtype)
    if len(data) != record["count"] * columns:
        raise ValueError(f"accessor {index} says {record['count']} rows, its view holds others")
    return data.reshape(-1, columns) if columns > 1 else data


def usd_faults(path: Path) -> list[str]:
    """What USD's own validators and the rules of AR viewers say against a USDC or USDZ."""
    from pxr import Tf, Usd, UsdGeom, UsdValidation

    faults = _package_faults(path) if path.suffix == ".usdz" else []
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        return [*faults, str(error).splitlines()[0]]
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    faults += [f"{e.GetName()}: {e.GetMessage()}" for e in context.Validate(stage)]
    if not stage.GetDefaultPrim():
        faults.append("no default prim")
    if UsdGeom.GetStageUpAxis(stage) != UsdGeom.Tokens.y:
        faults.append("up axis is not Y")
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        faults.append("metersPerUnit is not written")
    return faults


def _package_faults(path: Path) -> list[str]:
    """USDZ: nothing compressed, data aligned to 64 bytes, the USD layer first."""
    faults = []
    try:
        with zipfile.ZipFile(path) as package:
            entries = package.infolist()
            data = path.read_bytes()
    except (OSError, zipfile.BadZipFile) as error:
        return [f"not a package: {error}"]
    if not entries or not entries[0].filename.endswith((".usdc", ".usda")):
        faults.append("the first file is not a USD layer")
    for entry in entries:
        name, extra = struct.unpack_from("<HH", data, entry.header_offset + 26)
        if entry.compress_type != zipfile.ZIP_STORED:
            faults.append(f"{entry.filename} is compressed")
        if (entry.header_offset + 30 + name + extra) % 64:
            faults.append(f"{entry.filename} is not aligned to 64 bytes")
        if not entry.filename.lower().endswith((".usdc", ".usda", ".png", ".jpg", ".jpeg")):
            faults.append(f"{entry.filename} is of a kind that AR viewers refuse")
    return faults
