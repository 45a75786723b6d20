"""Checks on written files, made on the bytes that the user will get."""

import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from refdgs_pipe.errors import ExportError
from refdgs_pipe.export.glb_reading import (
    BYTE,
    array_of,
    source_of,
    split_glb,
    stored_array,
    view_of,
)

_MAGIC = {"image/png": b"\x89PNG\r\n\x1a\n", "image/jpeg": b"\xff\xd8\xff", "image/webp": b"RIFF"}
_UNIT, _BYTES_UNIT = 2e-3, 7e-3  # how far from 1 a unit vector may be; one of bytes


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
        document, binary = split_glb(path.read_bytes())
        return _document_faults(document, binary)
    except (ValueError, KeyError, IndexError, TypeError, struct.error) as error:
        return [f"structure: {error!r}"]


def _document_faults(document: dict[str, Any], binary: bytes) -> list[str]:
    faults = []
    if document["buffers"][0]["byteLength"] > len(binary):
        faults.append("the buffer is longer than its chunk")
    for number, view in enumerate(document["bufferViews"]):
        if view["byteOffset"] + view["byteLength"] > len(binary):
            faults.append(f"bufferView {number} ends outside the buffer")
    for image in document["images"]:
        if not view_of(document, binary, image["bufferView"]).startswith(_MAGIC[image["mimeType"]]):
            faults.append(f"image {image['name']} is not {image['mimeType']}")
    for texture in document["textures"]:
        if source_of(texture) >= len(document["images"]):
            faults.append("a texture names an image that is not there")
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            faults += _primitive_faults(document, binary, primitive)
    return faults


def _primitive_faults(
    document: dict[str, Any], binary: bytes, primitive: dict[str, Any]
) -> list[str]:
    names = primitive["attributes"]
    arrays = {name: array_of(document, binary, index) for name, index in names.items()}
    indices = array_of(document, binary, primitive["indices"])
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
        kind = document["accessors"][names[name]]["componentType"]
        if np.abs(length - 1).max(initial=0) > (_BYTES_UNIT if kind == BYTE else _UNIT):
            faults.append(f"{name} is not unit length everywhere")
    if not np.isin(arrays["TANGENT"][:, 3], (-1, 1)).all():
        faults.append("TANGENT has a sign that is neither 1 nor -1")
    record = document["accessors"][names["POSITION"]]
    stored = stored_array(document, binary, names["POSITION"])
    for key, bound in (("min", stored.min(0)), ("max", stored.max(0))):
        if not np.array_equal(np.array(record[key], np.float32), bound):
            faults.append(f"POSITION's {key} is not what the data says")
    return faults


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
    said = ((str(e.GetName()), str(e.GetMessage())) for e in context.Validate(stage))
    faults += [f"{name}: {text}" for name, text in said if not _is_unknown_mtlx(name, text)]
    if not stage.GetDefaultPrim():
        faults.append("no default prim")
    if UsdGeom.GetStageUpAxis(stage) != UsdGeom.Tokens.y:
        faults.append("up axis is not Y")
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        faults.append("metersPerUnit is not written")
    return faults


def _is_unknown_mtlx(name: str, text: str) -> bool:
    """Whether a node of MaterialX is not known because this USD has no plug-in for MaterialX."""
    from pxr import Plug

    has_plugin = Plug.Registry().GetPluginWithName("usdMtlx") is not None
    return name == "MissingShaderIdInRegistry" and "'ND_" in text and not has_plugin


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
