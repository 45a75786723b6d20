"""COLMAP models, text and binary, to arrays and back.

Format: https://colmap.github.io/format.html. Rigs and frames (COLMAP 4) repeat what trivial models
say in images.*; they are not read and not written.
"""

import os
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.documents import read_text
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.trouble import raise_if_machine

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MODEL_NAMES = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
)
_PARAM_COUNTS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12)
_OPENCV_SLOTS: dict[str, tuple[int, ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": (0,),
    "RADIAL": (0, 1),
    "OPENCV": (0, 1, 2, 3),
    "FULL_OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
_MAX_TEXT = 4_000_000_000  # bytes
_MAX_NAME = 4096  # bytes
_MAX_SIDE = 1_000_000  # pixels
_POINT2D = np.dtype([("xy", "<f8", 2), ("id", "<i8")])


@dataclass(frozen=True)
class ColmapCamera:
    model: str
    width: int
    height: int
    params: F64


@dataclass(frozen=True)
class ColmapImage:
    """Pose as quaternion wxyz and translation, cam_from_world; (n, 2) keypoints, (n,) point ids."""

    quat: F64
    translation: F64
    camera_id: int
    name: str
    keypoints: F64
    point_ids: I64


@dataclass(frozen=True)
class ColmapModel:
    """Cameras and images by id; points as (P,) ids, (P, 3) positions, colours, (P,) errors."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    point_ids: I64
    xyz: F64
    rgb: NDArray[np.uint8]
    errors: F64


def read_model(folder: Path) -> ColmapModel:
    """Read a binary model, or a text one.

    Raises:
        CorruptError: a file is missing, damaged, or of an unknown camera model.
    """
    try:
        if (folder / "cameras.bin").exists():
            return _read_binary(folder)
        return _read_text(folder)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise CorruptError(f"{folder}: no COLMAP model ({error.filename} is missing)") from None
    except (struct.error, ValueError, IndexError, KeyError, OverflowError) as error:
        raise CorruptError(f"{folder}: damaged COLMAP model ({error})") from None
    except OSError as error:
        raise_if_machine(error)
        raise CorruptError(f"{folder}: the model cannot be read ({error.strerror})") from None


def write_model(folder: Path, model: ColmapModel, *, text: bool = False) -> None:
    """Write cameras, images and points3D into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    tracks = _tracks(model)
    if text:
        _write_text(folder, model, tracks)
    else:
        _write_binary(folder, model, tracks)


def opencv_lens(model: str, params: F64) -> tuple[F64, F64]:
    """(3, 3) K and (8,) OpenCV distortion k1 k2 p1 p2 k3 k4 k5 k6 of a camera model.

    Raises:
        ValueError: a fisheye or another model that OpenCV's rational model cannot express.
    """
    if model not in _OPENCV_SLOTS:
        raise ValueError(f"camera model {model} is not supported: undistort to PINHOLE first")
    focals = 1 if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else 2
    fx, fy = params[0], params[focals - 1]
    cx, cy = params[focals : focals + 2]
    distortion = np.zeros(8)
    distortion[list(_OPENCV_SLOTS[model])] = params[focals + 2 :]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), distortion


def _tracks(model: ColmapModel) -> dict[int, list[tuple[int, int]]]:
    """point id -> (image id, index of its keypoint)."""
    tracks: dict[int, list[tuple[int, int]]] = {int(i): [] for i in model.point_ids}
    for image_id, image in model.images.items():
        for index in np.flatnonzero(image.point_ids >= 0):
            track = tracks.get(int(image.point_ids[index]))
            if track is not None:
                track.append((image_id, int(index)))
    return tracks


def _take(file: BinaryIO, layout: str) -> tuple[Any, ...]:
    return struct.unpack("<" + layout, file.read(struct.calcsize("<" + layout)))


def _counted(file: BinaryIO, least: int) -> int:
    """A count of entries, each of at least so many bytes, that the rest of the file can hold.

    Raises:
        ValueError: it cannot.
    """
    count = int(_take(file, "Q")[0])
    left = os.fstat(file.fileno()).st_size - file.tell()
    if count * least > left:
        raise ValueError(f"{Path(file.name).name} ends early: {count} entries in {left} bytes")
    return count


def _id32(text: str) -> int:
    """An id as the binary form can have it.

    Raises:
        ValueError: it cannot.
    """
    number = int(text)
    if not -(2**31) <= number < 2**31:
        raise ValueError(f"{text[:20]} is no id")
    return number


def _index(number: int, what: str) -> int:
    """An index as numpy has it.

    Raises:
        ValueError: it is negative.
    """
    if number < 0:
        raise ValueError(f"{number} is no {what}")
    return number


def _read_binary(folder: Path) -> ColmapModel:
    cameras, images = {}, {}
    with (folder / "cameras.bin").open("rb") as file:
        for _ in range(_counted(file, 24)):
            camera_id, model_id, width, height = _take(file, "iiQQ")
            params = np.array(_take(file, "d" * _PARAM_COUNTS[_index(model_id, "camera model")]))
            _check_size(width, height)
            cameras[camera_id] = ColmapCamera(MODEL_NAMES[model_id], width, height, params)
    with (folder / "images.bin").open("rb") as file:
        for _ in range(_counted(file, 73)):
            image_id, *pose, camera_id = _take(file, "i7di")
            name = _read_name(file)
            count = _counted(file, _POINT2D.itemsize)
            seen = np.frombuffer(file.read(count * _POINT2D.itemsize), _POINT2D, count)
            images[image_id] = ColmapImage(
                np.array(pose[:4]),
                np.array(pose[4:]),
                camera_id,
                name,
                seen["xy"].copy(),
                seen["id"].copy(),
            )
    rows = []
    with (folder / "points3D.bin").open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        for _ in range(_counted(file, 51)):
            row = _take(file, "Q3d3BdQ")
            if file.seek(8 * row[8], os.SEEK_CUR) > size:
                raise ValueError("points3D.bin ends early")
            rows.append(row[:8])
    return _model(cameras, images, rows)


def _read_name(file: BinaryIO) -> str:
    start = file.tell()
    name, end, _ = file.read(_MAX_NAME + 1).partition(b"\0")
    if not end:
        raise ValueError(f"images.bin ends early, or has a name of more than {_MAX_NAME} bytes")
    file.seek(start + len(name) + 1)
    return name.decode("utf-8")


def _check_size(width: int, height: int) -> None:
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise ValueError(f"a camera of {width} x {height} pixels cannot be meant")


def _model(
    cameras: dict[int, ColmapCamera], images: dict[int, ColmapImage], rows: list[tuple[Any, ...]]
) -> ColmapModel:
    table = np.array([row[1:] for row in rows], float).reshape(-1, 7)
    ids = np.array([row[0] for row in rows], np.int64)
    return ColmapModel(
        cameras, images, ids, table[:, :3], table[:, 3:6].astype(np.uint8), table[:, 6]
    )


def _lines(path: Path) -> list[str]:
    return [t for t in read_text(path, limit=_MAX_TEXT).splitlines() if not t.startswith("#")]


def _read_text(folder: Path) -> ColmapModel:
    cameras, images = {}, {}
    for line in filter(None, _lines(folder / "cameras.txt")):
        camera_id, name, width, height, *params = line.split()
        values = np.array(params, float)
        if len(values) != _PARAM_COUNTS[MODEL_NAMES.index(name)]:
            raise ValueError(f"camera {camera_id}: {name} has {len(values)} parameters")
        _check_size(int(width), int(height))
        cameras[_id32(camera_id)] = ColmapCamera(name, int(width), int(height), values)
    lines = _lines(folder / "images.txt")
    for pose, seen in zip(lines[::2], lines[1::2], strict=False):
        image_id, *numbers, camera_id, name = pose.split(" ", 9)
        values = np.array(numbers, float)
        if len(values) != 7:
            raise ValueError(f"image {image_id}: {len(values)} numbers, 7 expected")
        points = np.array(seen.split(), float).reshape(-1, 3)
        images[_id32(image_id)] = ColmapImage(
            values[:4],
            values[4:],
            _id32(camera_id),
            name.strip(),
            points[:, :2],
            points[:, 2].astype(np.int64),
        )
    rows: list[tuple[Any, ...]] = []
    for line in filter(None, _lines(folder / "points3D.txt")):
        point_id, *rest = line.split()[:8]
        if len(rest) != 7:
            raise ValueError(f"point {point_id}: {len(rest)} numbers, 7 expected")
        rows.append((_index(int(point_id), "point id"), *map(float, rest)))
    return _model(cameras, images, rows)


def _write_binary(
    folder: Path, model: ColmapModel, tracks: dict[int, list[tuple[int, int]]]
) -> None:
    with (folder / "cameras.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(model.cameras)))
        for camera_id, c in sorted(model.cameras.items()):
            head = (camera_id, MODEL_NAMES.index(c.model), c.width, c.height)
            file.write(struct.pack(f"<iiQQ{len(c.params)}d", *head, *c.params))
    with (folder / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(model.images)))
        for image_id, i in sorted(model.images.items()):
            file.write(struct.pack("<i7di", image_id, *i.quat, *i.translation, i.camera_id))
            file.write(i.name.encode("utf-8") + b"\0" + struct.pack("<Q", len(i.keypoints)))
            seen = np.empty(len(i.keypoints), _POINT2D)
            seen["xy"], seen["id"] = i.keypoints, i.point_ids
            file.write(seen.tobytes())
    with (folder / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", len(model.point_ids)))
        for key, xyz, rgb, error in zip(
            model.point_ids, model.xyz, model.rgb, model.errors, strict=True
        ):
            track = tracks[int(key)]
            file.write(struct.pack("<Q3d3BdQ", key, *xyz, *rgb, error, len(track)))
            file.write(np.array(track, "<i4").tobytes())


def _write_text(folder: Path, model: ColmapModel, tracks: dict[int, list[tuple[int, int]]]) -> None:
    cameras = [
        f"{key} {c.model} {c.width} {c.height} {_numbers(c.params)}"
        for key, c in sorted(model.cameras.items())
    ]
    images = []
    for key, i in sorted(model.images.items()):
        pose = _numbers([*i.quat, *i.translation])
        seen = zip(i.keypoints, i.point_ids, strict=True)
        images.append(f"{key} {pose} {i.camera_id} {i.name}")
        images.append(" ".join(f"{_numbers(xy)} {point}" for xy, point in seen))
    points = []
    for key, xyz, rgb, error in zip(
        model.point_ids, model.xyz, model.rgb, model.errors, strict=True
    ):
        track = " ".join(f"{image} {index}" for image, index in tracks[int(key)])
        points.append(f"{key} {_numbers(xyz)} {rgb[0]} {rgb[1]} {rgb[2]} {float(error)!r} {track}")
    headers = {
        "cameras": "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]",
        "images": "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then X Y POINT3D_ID ...",
        "points3D": "# POINT3D_ID X Y Z R G B ERROR IMAGE_ID POINT2D_INDEX ...",
    }
    for name, rows in (("cameras", cameras), ("images", images), ("points3D", points)):
        text = "\n".join([headers[name], *rows]) + "\n"
        (folder / f"{name}.txt").write_text(text, encoding="utf-8")


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)
