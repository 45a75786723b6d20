"""nerfstudio and instant-ngp: one transforms.json with the lens and a pose for every photo."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from refdgs_pipe.artifacts.capture import (
    Frame,
    Layout,
    frame_files,
    named_frames,
    read_frames,
    read_transforms,
)
from refdgs_pipe.artifacts.views import KnownPose, Skipped
from refdgs_pipe.camera import F64, Lens, opencv_from_opengl
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.files.images import read_header

_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")


def read_nerfstudio(layout: Layout) -> tuple[list[Frame], list[Skipped]]:
    """Every frame with its pose in the frame before `applied_transform`, and what is missing.

    Raises:
        InputError: the JSON is damaged, tells no focal length, or a lens that cannot be undone.
    """
    path = layout.model[0]
    shared = read_transforms(path)
    undo = _undo_applied(path, shared)
    tests = {Path(str(name)).name for name in _list(shared.get("test_filenames"))}
    found: list[tuple[Path, Path | None, str, KnownPose | None]] = []
    skipped = []
    for record in read_frames(path):
        photo, mask = frame_files(layout.root, record)
        try:
            if photo is None:
                raise CaptureError("named in the JSON but not there")
            header = read_header(photo)
        except CaptureError as error:
            skipped.append(Skipped(str(record["file_path"]), str(error)))
            continue
        lens = _lens(path, {**shared, **record}, header.width, header.height)
        pose = opencv_from_opengl(_rigid(path, undo @ _matrix(path, record)))
        split = "test" if photo.name in tests else "train"
        found.append((photo, mask, split, KnownPose(lens, pose)))
    return named_frames(layout.root, found), skipped


def _lens(path: Path, record: dict[str, Any], width: int, height: int) -> Lens:
    """The lens in pixels of the file, which may be smaller than the one the JSON speaks of."""
    model = record.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise InputError(f"{path}: camera_model {model} is not supported: undistort the photos")
    w, h = float(record.get("w", width)), float(record.get("h", height))
    try:
        if "fl_x" in record:
            fx = float(record["fl_x"])
        else:
            fx = w / 2 / math.tan(float(record["camera_angle_x"]) / 2)
        fy = float(record.get("fl_y", fx))
        K = np.array(
            [[fx, 0, record.get("cx", w / 2)], [0, fy, record.get("cy", h / 2)], [0, 0, 1]]
        )
        distortion = np.array([float(record.get(key, 0.0)) for key in _DISTORTION])
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"{path}: needs fl_x or camera_angle_x as numbers ({error})") from None
    return Lens(np.diag([width / w, height / h, 1.0]) @ K.astype(float), distortion)


def _matrix(path: Path, record: dict[str, Any]) -> F64:
    matrix = np.array(record.get("transform_matrix"), dtype=object)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{path}: {record['file_path']} has no 4 x 4 transform_matrix")
    return np.vstack([matrix[:3].astype(float), [0.0, 0.0, 0.0, 1.0]])


def _undo_applied(path: Path, shared: dict[str, Any]) -> F64:
    """(4, 4) from the JSON's world back to the one before nerfstudio turned and scaled it."""
    out = np.eye(4)
    if "applied_transform" in shared:
        given = np.array(shared["applied_transform"], float)
        if given.shape not in ((3, 4), (4, 4)) or abs(np.linalg.det(given[:3, :3])) < 1e-9:
            raise InputError(f"{path}: applied_transform is not an invertible 3 x 4 matrix")
        out[:3] = given[:3]
    scale = float(shared.get("applied_scale", 1.0))
    return np.asarray(np.linalg.inv(out) @ np.diag([1 / scale, 1 / scale, 1 / scale, 1.0]))


def _rigid(path: Path, world_from_cam: F64) -> F64:
    """The pose without the scale that some exporters leave in its axes."""
    axes = world_from_cam[:3, :3]
    U, sizes, Vt = np.linalg.svd(axes)
    if sizes[2] < 0.99 * sizes[0] or np.linalg.det(axes) <= 0:
        raise InputError(f"{path}: a transform_matrix is mirrored or sheared, not a camera's pose")
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = U @ Vt, world_from_cam[:3, 3]
    return out


def _list(value: object) -> list[object]:
    return value if isinstance(value, list) else []
