"""The user's photos, wherever they lie and however they are laid out. Read only."""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from refdgs_pipe.artifacts.truth import all_truth_files, photo_truth_files
from refdgs_pipe.artifacts.views import KnownPose
from refdgs_pipe.errors import CaptureError, InputError

Kind = Literal["photos", "blender", "nerfstudio", "nero", "colmap"]
MaskKind = Literal["drawn", "alpha", "depth"]
_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "")


@dataclass(frozen=True)
class Frame:
    """One photo of a capture, not read yet.

    Args:
        path: the file; source: its name relative to the capture.
        name: unique in the capture, safe as a file name.
        mask: the file of its mask, or None.
        mask_kind: "drawn" over the photo; "alpha", an alpha channel in a file of its own; "depth",
            NeRO's 16-bit depth, whose far end is the background.
        split: "train" or "test".
        known: its pose, with the lens in pixels of the file as stored, or None.
    """

    path: Path
    source: str = ""
    name: str = ""
    mask: Path | None = None
    mask_kind: MaskKind = "drawn"
    split: str = "train"
    known: KnownPose | None = None


@dataclass(frozen=True)
class Layout:
    """What a capture turned out to be.

    Args:
        kind: photos, or which sort of data set with known poses.
        root: the folder that relative names start from.
        photos: photo candidates (kinds "photos", "nero" and "colmap"), in natural order.
        masks: the folder of masks, or None.
        model: files that hold the known poses.
    """

    kind: Kind
    root: Path
    photos: tuple[Path, ...] = ()
    masks: Path | None = None
    model: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Capture:
    """A folder of photos, a list of photos, or a data set with known poses."""

    paths: tuple[Path, ...]

    def layout(self) -> Layout:
        """Find out what was given.

        Raises:
            CaptureError: a path does not exist, or nothing in it could be a photo.
        """
        for path in self.paths:
            if not path.exists():
                raise CaptureError(f"{path}: no such file or folder. Give a folder of photos")
        if len(self.paths) == 1 and self.paths[0].is_dir():
            return _folder_layout(self.paths[0])
        if len(self.paths) == 1 and self.paths[0].suffix == ".json":
            return _json_layout(self.paths[0])
        return _list_layout(self.paths)

    def files(self) -> list[tuple[str, Path]]:
        """Every file that reading this capture would open, as (relative name, path), sorted.

        The ground truth of a data set is among them: a score must not outlive its truth.

        Raises:
            CaptureError: a path does not exist, or nothing in it could be a photo.
        """
        found = self.layout()
        files = {*found.photos, *found.model}
        if found.kind in ("blender", "nerfstudio"):
            for model in found.model:
                for record in read_frames(model):
                    files.update(p for p in frame_files(found.root, record) if p is not None)
        if found.kind == "nero":
            files.update(p for p in map(nero_depth, found.photos) if p.is_file())
        if found.kind in ("blender", "nerfstudio", "nero"):
            files |= all_truth_files(found.root, list(files))
        if found.kind == "photos":
            files |= photo_truth_files(found.root)
        if found.masks is not None:
            files.update(_visible_files(found.masks))
        return sorted((relative_name(found.root, path), path) for path in files)


def relative_name(root: Path, path: Path) -> str:
    """The path below `root` with forward slashes, or the bare name if it is elsewhere."""
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name


def read_frames(path: Path) -> list[dict[str, object]]:
    """The `frames` of a transforms JSON.

    Raises:
        InputError: the file is not such a JSON.
    """
    frames: Any = read_transforms(path).get("frames")
    is_list = isinstance(frames, list)
    if not (is_list and all(isinstance(f, dict) and "file_path" in f for f in frames)):
        raise InputError(f"{path}: has no list `frames` with a `file_path` each")
    return list(frames)


def read_transforms(path: Path) -> dict[str, object]:
    """The whole of a transforms JSON.

    Raises:
        InputError: the file is not JSON, or not an object.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: not readable as JSON ({error})") from None
    if not isinstance(record, dict):
        raise InputError(f"{path}: expected an object with `frames`, found something else")
    return record


def frame_files(root: Path, record: dict[str, object]) -> tuple[Path | None, Path | None]:
    """The photo and the mask of one entry of `frames`; None where the file does not exist.

    Without a `mask_path` the mask is r_0_alpha.png beside r_0.png (Shiny Blender's ball).
    """
    photo = _with_suffix(root / str(record["file_path"]))
    if (mask := record.get("mask_path")) is not None:
        return photo, _with_suffix(root / str(mask))
    if photo is None:
        return None, None
    return photo, _with_suffix(photo.with_name(f"{photo.stem}_alpha.png"))


def nero_depth(photo: Path) -> Path:
    """Where NeRO's GlossySynthetic keeps the depth of a photo: 7-depth.png beside 7.png."""
    return photo.with_name(f"{photo.stem}-depth.png")


def named_frames(root: Path, frames: list[Frame]) -> list[Frame]:
    """The frames, named after their place below `root`."""
    sources = [relative_name(root, frame.path) for frame in frames]
    names = safe_names(sources)
    return [
        replace(frame, source=source, name=name)
        for frame, source, name in zip(frames, sources, names, strict=True)
    ]


def safe_names(sources: list[str]) -> list[str]:
    """Unique names without folders or suffixes: "train/r_0.png" becomes "train_r_0"."""
    stems = [_safe(source.rsplit(".", 1)[0]) for source in sources]
    whole = [_safe(source.replace(".", "_")) for source in sources]
    twice = {stem.lower() for i, stem in enumerate(stems) if stem.lower() in _lower(stems[:i])}
    names = [w if s.lower() in twice else s for s, w in zip(stems, whole, strict=True)]
    for i in range(len(names)):
        while names[i].lower() in _lower(names[:i]):
            names[i] += f"_{i}"
    return names


def _lower(names: list[str]) -> set[str]:
    return {name.lower() for name in names}


def _safe(text: str) -> str:
    return re.sub(r"[^\w.+-]+", "_", text.removeprefix("./")).strip("._") or "photo"


def _with_suffix(path: Path) -> Path | None:
    """NeRF-synthetic files leave the suffix out."""
    for candidate in (path, *(path.with_name(path.name + s) for s in (".png", ".jpg", ".jpeg"))):
        if candidate.is_file():
            return candidate
    return None


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key: IMG_2 before IMG_10."""
    parts = re.split(r"(\d+)", path.as_posix())
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts if p]


def _visible_files(folder: Path) -> list[Path]:
    """Regular files below a folder, in natural order, hidden ones and hidden folders left out."""
    found = [
        path
        for path in folder.rglob("*")
        if path.is_file() and not any(p.startswith(".") for p in path.relative_to(folder).parts)
    ]
    return sorted(found, key=_natural)


def _folder_layout(root: Path) -> Layout:
    trains = [root / f"transforms_{split}.json" for split in ("train", "test")]
    if trains[0].is_file():
        return Layout("blender", root, model=tuple(p for p in trains if p.is_file()))
    if (root / "transforms.json").is_file():
        return Layout("nerfstudio", root, model=(root / "transforms.json",))
    if cameras := _nero_cameras(root):
        photos = [path for path in root.glob("*.png") if path.stem.isdecimal()]
        return Layout("nero", root, tuple(sorted(photos, key=_natural)), model=cameras)
    places = (root / "images", root / "colmap" / "images")
    images = next((place for place in places if place.is_dir()), None)
    direct = [p for p in root.iterdir() if p.is_file() and not p.name.startswith(".")]
    model = _colmap_files(root)
    if images is not None and (model or not any(_may_be_photo(p) for p in direct)):
        home, among = images, images / "masks"
        photos = [p for p in _visible_files(images) if among not in p.parents]
    else:
        home, model = root, ()
        photos = sorted(direct, key=_natural)
    masks = next((p for p in (root / "masks", home / "masks") if p.is_dir()), None)
    if model:
        return Layout("colmap", home, tuple(photos), masks, model)
    if not photos:
        raise CaptureError(f"{root}: the folder holds no files. Put the photos into it")
    return Layout("photos", home, tuple(photos), masks)


def _nero_cameras(root: Path) -> tuple[Path, ...]:
    """NeRO's GlossySynthetic: 0-camera.pkl, 1-camera.pkl, ..., or ()."""
    found = root.glob("*-camera.pkl")
    numbered = [path for path in found if path.name.removesuffix("-camera.pkl").isdecimal()]
    return tuple(sorted(numbered, key=_natural))


def _json_layout(path: Path) -> Layout:
    if path.name == "transforms_train.json":
        return _folder_layout(path.parent)
    return Layout("nerfstudio", path.parent, model=(path,))


def _list_layout(paths: tuple[Path, ...]) -> Layout:
    folders = [path for path in paths if path.is_dir()]
    if folders:
        raise CaptureError(f"{folders[0]} is a folder among files: give one folder, or only files")
    parents = {path.parent for path in paths}
    root = paths[0].parent
    masks = root / "masks" if len(parents) == 1 and (root / "masks").is_dir() else None
    return Layout("photos", root, tuple(sorted(paths, key=_natural)), masks)


def _colmap_files(root: Path) -> tuple[Path, ...]:
    """The files of the COLMAP model in a workspace, or ()."""
    for below in _MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            names = ("cameras", "images", "points3D")
            files = tuple(root / below / (name + suffix) for name in names)
            if all(file.is_file() for file in files):
                return files
    return ()


def _may_be_photo(path: Path) -> bool:
    return path.suffix.lower() not in ("", ".txt", ".md", ".json", ".db", ".ply", ".log", ".xml")
