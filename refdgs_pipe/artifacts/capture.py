"""The user's photos, wherever they lie and however they are laid out. Read only."""

import os
import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from refdgs_pipe.artifacts.truth import all_truth_files, photo_truth_files
from refdgs_pipe.artifacts.views import KnownPose
from refdgs_pipe.documents import parse_json, read_text
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.files.archive import check_zip, unpack_zip
from refdgs_pipe.files.kinds import is_candidate, sniff
from refdgs_pipe.formatting import printable
from refdgs_pipe.names import fault_of, leads_out
from refdgs_pipe.trouble import raise_if_machine

Kind = Literal["photos", "blender", "nerfstudio", "nero", "colmap"]
MaskKind = Literal["drawn", "alpha", "depth"]
WHAT_IS_READ = "JPEG, PNG, TIFF, WebP, HEIC, AVIF, camera RAW and films (MP4, MOV) are read"
_MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "")
_MASK_FOLDERS = ("masks", "mask")
_NAMES_SHOWN = 4


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
        masks: the folders of masks, also in sub-folders of photos.
        model: files that hold the known poses.
    """

    kind: Kind
    root: Path
    photos: tuple[Path, ...] = ()
    masks: tuple[Path, ...] = ()
    model: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Capture:
    """A folder of photos, a ZIP of one, a list of photos, or a data set with known poses."""

    paths: tuple[Path, ...]

    def opened(self, scratch: Path) -> "Capture":
        """The capture itself; or, if it is a ZIP, the folder in it, unpacked below `scratch`.

        Raises:
            CaptureError: the ZIP is damaged, too large, or holds what must not be unpacked.
            WriteError: the disk has no room for it.
        """
        if not self._is_zip():
            return self
        folder = scratch / "unpacked"
        shutil.rmtree(folder, ignore_errors=True)
        unpack_zip(self.paths[0], folder)
        inside = [path for path in folder.iterdir() if not path.name.startswith(".")]
        while len(inside) == 1 and inside[0].is_dir():
            folder = inside[0]
            inside = list(folder.iterdir())
        return Capture((folder,))

    def _is_zip(self) -> bool:
        return len(self.paths) == 1 and self.paths[0].is_file() and sniff(self.paths[0]) == "zip"

    def layout(self) -> Layout:
        """Find out what was given. Of a ZIP, whose layout is known once it is opened, nothing.

        Raises:
            CaptureError: a path does not exist, nothing in it could be a photo, or a photo is a
                link out of it.
        """
        found = self._layout()
        _refuse_links(found, self.paths)
        return found

    def _layout(self) -> Layout:
        for path in self.paths:
            if not path.exists():
                raise CaptureError(
                    f"{printable(path)}: no such file or folder. Give a folder of photos"
                )
        if self._is_zip():
            return Layout("photos", self.paths[0])
        if len(self.paths) == 1 and self.paths[0].is_dir():
            return _folder_layout(self.paths[0])
        if len(self.paths) == 1 and self.paths[0].suffix == ".json":
            return _json_layout(self.paths[0])
        return _list_layout(self.paths)

    def files(self) -> list[tuple[str, Path]]:
        """Every file that reading this capture would open, as (relative name, path), sorted.

        Notes, sidecars and other files beside the photos are not among them. A ZIP is one file.
        The ground truth of a data set is among them: a score must not outlive its truth.

        Raises:
            CaptureError: a path does not exist, or nothing in it could be a photo.
        """
        found = self.layout()
        if self._is_zip():
            check_zip(self.paths[0])
            return [(printable(self.paths[0].name), self.paths[0])]
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
        for folder in found.masks:
            masks = [path for path in _visible_files(folder) if is_candidate(path)]
            _refuse_links(replace(found, photos=tuple(masks)), self.paths)
            files.update(masks)
        return sorted((relative_name(found.root, path), path) for path in files)


def relative_name(root: Path, path: Path) -> str:
    """The path below `root` with forward slashes, or the bare name elsewhere; printable."""
    below = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
    return printable(below)


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
        record = parse_json(read_text(path))
    except (ValueError, OSError) as error:
        raise_if_machine(error)
        raise InputError(f"{path}: not readable as JSON ({error})") from None
    if not isinstance(record, dict):
        raise InputError(f"{path}: expected an object with `frames`, found something else")
    return record


def frame_files(root: Path, record: dict[str, object]) -> tuple[Path | None, Path | None]:
    """The photo and the mask of one entry of `frames`; None where the file does not exist.

    Without a `mask_path` the mask is r_0_alpha.png beside r_0.png (Shiny Blender's ball).

    Raises:
        InputError: a name leads out of the folder.
    """
    photo = _named_file(root, "file_path", record["file_path"])
    if (mask := record.get("mask_path")) is not None:
        return photo, _named_file(root, "mask_path", mask)
    if photo is None:
        return None, None
    return photo, _named_file(root, "mask", f"{photo.relative_to(root).with_suffix('')}_alpha.png")


def _named_file(root: Path, key: str, name: object) -> Path | None:
    """The file that a data set names, if it exists; it must lie in the data set's folder."""
    fault = fault_of(name)
    path = None if fault else _with_suffix(root / str(name))
    if path is not None and leads_out(root, path):
        fault = f"it is a link to {path.resolve()}"
    if fault:
        raise InputError(
            printable(f"{root}: {key} {str(name)!r}: {fault}. Files must lie in that folder")
        )
    return path


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


def _visible_files(folder: Path, *, leave_out: tuple[str, ...] = ()) -> list[Path]:
    """Regular files below a folder, in natural order.

    Hidden files and folders, our own workspaces and folders called as in `leave_out` are not
    entered.
    """
    found: list[Path] = []
    for place, folders, names in os.walk(folder):
        here = Path(place)
        folders[:] = [
            name
            for name in folders
            if not name.startswith(".")
            and name != "__MACOSX"
            and name.lower() not in leave_out
            and not name.endswith(".refdgs")
            and not (here / name / "workspace.json").is_file()
        ]
        paths = [here / name for name in names if not name.startswith(".")]
        found += [path for path in paths if path.is_file()]
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
    home = root
    if images is not None and (model or not any(is_candidate(path) for path in direct)):
        home = images
    else:
        model = ()
    files = _visible_files(home, leave_out=_MASK_FOLDERS)
    found = tuple(path for path in files if is_candidate(path))
    masks = _mask_folders(root, home)
    if model:
        return Layout("colmap", home, found, masks, model)
    if not found:
        raise CaptureError(printable(_no_photos(root, files)))
    return Layout("photos", home, found, masks)


def _no_photos(root: Path, files: list[Path]) -> str:
    """Why a folder without photos is refused."""
    if not files:
        return f"{root}: the folder holds no files. Put the photos into it"
    names = ", ".join(path.name for path in files[:_NAMES_SHOWN])
    more = f" and {len(files) - _NAMES_SHOWN} more" if len(files) > _NAMES_SHOWN else ""
    zips = [path.name for path in files if sniff(path) == "zip"]
    advice = f". Give the ZIP itself: {root / zips[0]}" if zips else ""
    return (
        f"{root}: none of the {len(files)} files is a photo ({names}{more}). {WHAT_IS_READ}{advice}"
    )


def _mask_folders(root: Path, home: Path) -> tuple[Path, ...]:
    """The folders called masks or mask, in any case: in `root`, in `home` and below it."""
    found = [root / name for name in _folders_in(root) if name.lower() in _MASK_FOLDERS]
    for place, folders, _ in os.walk(home):
        here = [name for name in folders if name.lower() in _MASK_FOLDERS]
        found += [Path(place) / name for name in sorted(here)]
        folders[:] = [name for name in folders if name not in here and not name.startswith(".")]
    return tuple(dict.fromkeys(found))


def _folders_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.is_dir())


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
        name = printable(folders[0])
        raise CaptureError(f"{name} is a folder among files: give one folder, or only files")
    for path in paths:
        if sniff(path) == "zip":
            name = printable(path)
            raise CaptureError(f"{name} is a ZIP among files: give one ZIP, or only photos")
    parents = {path.parent for path in paths}
    root = paths[0].parent
    names = _folders_in(root) if len(parents) == 1 else []
    masks = tuple(root / name for name in names if name.lower() in _MASK_FOLDERS)
    return Layout("photos", root, tuple(sorted(paths, key=_natural)), masks)


def _refuse_links(found: Layout, given: tuple[Path, ...]) -> None:
    """A photo may be a link only to what lies in the capture, or where the user named the link.

    Raises:
        CaptureError: one leads out of the folder.
    """
    roots = [path for path in (*given, found.root, *found.masks) if path.is_dir()]
    for path in (*found.photos, *found.model):
        if path.is_symlink() and path not in given and all(leads_out(r, path) for r in roots):
            raise CaptureError(
                printable(
                    f"{path} is a link out of the folder, to {path.resolve()}. Copy the file there,"
                    " or give the files themselves"
                )
            )


def _colmap_files(root: Path) -> tuple[Path, ...]:
    """The files of the COLMAP model in a workspace, or ()."""
    for below in _MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            names = ("cameras", "images", "points3D")
            files = tuple(root / below / (name + suffix) for name in names)
            if all(file.is_file() for file in files):
                return files
    return ()
