"""The photos as the pipeline works on them: upright, one folder, one colour space."""

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Self
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64, Lens
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.names import fault_of

ColorSpace = Literal["srgb", "linear"]
Background = Literal["photo", "removed", "masked"]


@dataclass(frozen=True)
class Exif:
    """What the camera wrote about a photo; None where it did not say.

    Args:
        sensor_width_mm: of the long side; None, too, if the file contradicts it.
        exif_width, exif_height: pixels of the photo as the camera took it.
        flash: whether it fired.
        is_whole: false for a photo that was cropped after it was taken.
    """

    make: str | None = None
    model: str | None = None
    lens: str | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None
    sensor_width_mm: float | None = None
    time: str | None = None
    exposure_s: float | None = None
    aperture: float | None = None
    iso: float | None = None
    exif_width: int | None = None
    exif_height: int | None = None
    flash: bool | None = None
    is_whole: bool = True

    @property
    def focal_fraction(self) -> float | None:
        """Focal length divided by the image's long side, or None if the EXIF does not tell.

        The sensor's size is preferred to the 35 mm equivalent, which is rounded and may be meant
        by the diagonal; a resized file often keeps a stale resolution, which then disagrees.
        """
        if not self.is_whole:
            return None
        by_film = self.focal_35mm / 36.0 if self.focal_35mm else None
        by_sensor = None
        if self.focal_mm and self.sensor_width_mm:
            by_sensor = self.focal_mm / self.sensor_width_mm
        if by_sensor and by_film and not 0.85 < by_sensor / by_film < 1.18:
            by_sensor = None
        best = by_sensor or by_film
        return best if best and 0.3 < best < 20 else None


@dataclass(frozen=True)
class KnownPose:
    """A pose that came with the capture; `lens` is in pixels of the view's image."""

    lens: Lens
    cam_from_world: F64


@dataclass(frozen=True)
class View:
    """One usable photo.

    Args:
        name: unique in the capture, safe as a file name.
        file: the image below `Views.folder`; always a PNG.
        width, height: pixels of that image.
        mask: soft object mask below `Views.folder` (white is object), or None.
        split: "train", or "test" for a view held out from training.
        sharpness: variance of the Laplacian at a fixed scale, 8-bit levels squared.
        exposure: mean linear luminance in [0, 1].
        source: the user's file, relative to the capture.
        placing: a larger 8-bit sRGB PNG of the same photo below `Views.folder`, for structure from
            motion; None where the image itself serves.
        source_size: width and height of the user's file, upright, pixels.
    """

    name: str
    file: str
    width: int
    height: int
    mask: str | None
    split: str
    exif: Exif
    sharpness: float
    exposure: float
    known: KnownPose | None
    source: str
    placing: str | None = None
    source_size: tuple[int, int] | None = None


@dataclass(frozen=True)
class Skipped:
    """A file that was not used, and why. Nobody misses a `harmless` one: it was no photo.

    Args:
        copy_of: the photo that it shows again, relative to the capture; "" if it is no copy.
    """

    name: str
    reason: str
    harmless: bool = False
    copy_of: str = ""


@dataclass(frozen=True)
class KnownPoints:
    """Sparse points that came with the poses.

    Args:
        xyz: (P, 3) world; colors: (P, 3) uint8 sRGB.
        tracks: for each view name the (n,) int64 indices of the points it sees.
    """

    xyz: F64
    colors: NDArray[np.uint8]
    tracks: dict[str, NDArray[np.int64]]


@dataclass(frozen=True)
class Views:
    """All usable photos of a capture.

    Args:
        folder: holds images/, masks/, placing/ and views.json.
        items: sorted as the photos were taken (by name).
        color_space: "srgb" or "linear" (16-bit, from camera RAW).
        background: "photo": nothing is masked; "masked": real photos with masks; "removed": the
            background was removed and the colour is straight (not premultiplied).
        skipped: what was not usable.
        points: sparse points of a known model, if any.
    """

    folder: Path
    items: tuple[View, ...]
    color_space: ColorSpace
    background: Background
    skipped: tuple[Skipped, ...] = ()
    points: KnownPoints | None = None

    def __getitem__(self, name: str) -> View:
        """The view of that name."""
        return next(view for view in self.items if view.name == name)

    @property
    def has_known_poses(self) -> bool:
        return bool(self.items) and all(view.known is not None for view in self.items)

    def image_path(self, view: View) -> Path:
        return self.folder / view.file

    def placing_path(self, view: View) -> Path:
        """The picture that structure from motion reads: `placing`, or the view's own image."""
        return self.folder / (view.placing or view.file)

    def mask_path(self, view: View) -> Path | None:
        return None if view.mask is None else self.folder / view.mask

    def save(self, folder: Path) -> None:
        """Write views.json (and points.npz); the pictures are copied unless they are there."""
        folder.mkdir(parents=True, exist_ok=True)
        if folder != self.folder:
            for view in self.items:
                for file in filter(None, (view.file, view.mask, view.placing)):
                    (folder / file).parent.mkdir(parents=True, exist_ok=True)
                    shutil.copyfile(self.folder / file, folder / file)
        record = {
            "color_space": self.color_space,
            "background": self.background,
            "views": [_view_to_json(view) for view in self.items],
            "skipped": [asdict(s) for s in self.skipped],
        }
        (folder / "views.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
        if self.points is not None:
            tracks = {f"track/{name}": ids for name, ids in self.points.tracks.items()}
            np.savez(
                folder / "points.npz",
                allow_pickle=False,
                xyz=self.points.xyz,
                colors=self.points.colors,
                **tracks,
            )

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: a file is missing or damaged, or a name leads out of the folder.
        """
        try:
            return cls._load(folder)
        except (
            OSError,
            EOFError,
            BadZipFile,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            IndexError,
        ) as error:
            raise CorruptError(f"{folder / 'views.json'}: {error}") from None

    @classmethod
    def _load(cls, folder: Path) -> Self:
        record = json.loads((folder / "views.json").read_text(encoding="utf-8"))
        items = tuple(_view_from_json(r) for r in record["views"])
        skipped = tuple(Skipped(**s) for s in record["skipped"])
        points = None
        if (folder / "points.npz").exists():
            with np.load(folder / "points.npz", allow_pickle=False) as data:
                tracks = {k[6:]: data[k] for k in data.files if k.startswith("track/")}
                points = KnownPoints(data["xyz"], data["colors"], tracks)
        return cls(folder, items, record["color_space"], record["background"], skipped, points)


def _view_to_json(view: View) -> dict[str, Any]:
    record = {k: v for k, v in vars(view).items() if k not in ("exif", "known")}
    record["exif"] = asdict(view.exif)
    if view.known is not None:
        record["known"] = {
            "K": view.known.lens.K.tolist(),
            "distortion": view.known.lens.distortion.tolist(),
            "cam_from_world": view.known.cam_from_world.tolist(),
        }
    return record


def _view_from_json(record: dict[str, Any]) -> View:
    for name in (record["name"], record["file"], record.get("mask"), record.get("placing")):
        if name is not None and (fault := fault_of(name)):
            raise ValueError(f"{name}: {fault}")
    if "/" in record["name"]:
        raise ValueError(f"{record['name']}: a view's name has no folder")
    known = record.pop("known", None)
    if known is not None:
        lens = Lens(np.array(known["K"], float), np.array(known["distortion"], float))
        known = KnownPose(lens, np.array(known["cam_from_world"], float))
    size = record.pop("source_size", None)
    size = None if size is None else (int(size[0]), int(size[1]))
    exif = Exif(**record["exif"])
    return View(**{**record, "exif": exif, "known": known, "source_size": size})
