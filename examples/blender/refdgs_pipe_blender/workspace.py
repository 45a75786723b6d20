"""A workspace of refdgs-pipe as the add-on reads it. No bpy here. Nothing is ever written."""

import json
import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .errors import AddonError

MOST = 64_000_000  # bytes of a JSON file
_KEY = re.compile(r"[0-9a-f]{16}")


@dataclass(frozen=True)
class Asset:
    """The exported files of a workspace.

    Args:
        name: of the workspace, without ".refdgs".
        root: the workspace.
        glb: the textured mesh: metres, +Y up.
        light: the lat-long picture of the light, or None (recipe `matte`).
        scene: the USD layer with the cameras of the photos, or None.
    """

    name: str
    root: Path
    glb: Path
    light: Path | None
    scene: Path | None


@dataclass(frozen=True)
class Picture:
    """A photo as the program read it: upright, and a PNG. Its lens distorts it still.

    Args:
        name: of the photo, without its ending.
        width, height: pixels.
    """

    name: str
    path: Path
    width: int
    height: int


def absolute(path: str) -> Path:
    """The path from the root of the file system, as the program takes it: links stay links."""
    return Path(os.path.normpath(Path.cwd() / path))


def root_for(photos: str, workspace: str) -> Path:
    """Where a run of these photos puts its results: PHOTOS.refdgs beside them by default.

    Args:
        photos: a folder, a ZIP, a video or a workspace; may be "" if a workspace is given.

    Raises:
        AddonError: neither is given, or the photos are the root of the file system.
    """
    if workspace:
        return absolute(workspace)
    if not photos:
        raise AddonError("Neither photos nor a workspace are chosen. Choose one of them")
    path = absolute(photos)
    if (path / "workspace.json").is_file():
        return path
    if path.is_file():
        return path.with_suffix(".refdgs")
    if not path.name:
        raise AddonError(f"{path}: the root of the file system. Choose a folder of photos")
    return path.with_name(f"{path.name}.refdgs")


def asset_of(root: Path) -> Asset:
    """The exported files of a workspace.

    Raises:
        AddonError: there is no such workspace, or it has no asset.
    """
    if not root.is_dir():
        raise AddonError(f"{root}: there is no such workspace. Press Run to make it")
    folder = root / "asset"
    glb = _file(folder, "asset.glb")
    if glb is None:
        raise AddonError(f"{folder}: asset.glb is not there. Press Run to make the asset")
    return Asset(
        name=root.name.removesuffix(".refdgs") or root.name,
        root=root,
        glb=glb,
        light=_file(folder, "environment.hdr"),
        scene=_file(folder, "scene.usda"),
    )


def pictures(root: Path) -> dict[str, Picture]:
    """Name of the camera in scene.usda -> its photo. Photos that are gone are left out.

    Cameras have the name of their photo, and other characters than A-Z, a-z, 0-9 and _ are _.
    Photos whose names become equal by that are left out: which is which is not known.
    """
    folder = _result(root, "ingest")
    views = _read(folder / "views.json").get("views") if folder else None
    found: dict[str, Picture | None] = {}
    for view in views if isinstance(views, list) else ():
        with suppress(KeyError, TypeError, ValueError, AttributeError):
            size = int(view["width"]), int(view["height"])
            path = _file(folder, str(view["file"])) if folder else None
            name = camera_name(str(view["name"]))
            if path is not None and min(size) > 0:
                known = name in found
                found[name] = None if known else Picture(str(view["name"]), path, *size)
    return {name: picture for name, picture in found.items() if picture is not None}


def camera_name(name: str) -> str:
    """A photo's name as an identifier of USD (`Tf.MakeValidIdentifier`)."""
    plain = re.sub(rb"[^A-Za-z0-9_]", b"_", name.encode("utf-8", "replace")).decode("ascii")
    return re.sub(r"^[0-9]", "_", plain) or "_"


def _result(root: Path, stage: str) -> Path | None:
    """The folder of a stage's current result."""
    note = _file(root / stage, ".current")
    with suppress(OSError, UnicodeDecodeError):
        key = note.read_text("utf-8").strip() if note else ""
        folder = root / stage / key
        if _KEY.fullmatch(key) and folder.is_dir() and not folder.is_symlink():
            return folder
    return None


def _file(folder: Path, name: str) -> Path | None:
    """A file below a folder; None if there is none, or if a name or a link leads elsewhere."""
    with suppress(OSError, ValueError):
        path = folder / name
        inside = path.resolve().is_relative_to(folder.resolve())
        if inside and path.is_file() and not path.is_symlink():
            return path
    return None


def _read(path: Path) -> dict[str, Any]:
    """A JSON object; {} if it cannot be read."""
    with suppress(OSError, ValueError, RecursionError):
        if path.stat().st_size <= MOST:
            record = json.loads(path.read_text("utf-8"))
            return record if isinstance(record, dict) else {}
    return {}
