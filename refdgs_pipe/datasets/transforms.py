"""What the JSONs of NeRF-synthetic, nerfstudio and their kin have in common."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from refdgs_pipe.artifacts.capture import Frame, frame_files, read_frames
from refdgs_pipe.artifacts.views import KnownPose, Skipped
from refdgs_pipe.camera import F64, Lens, opencv_from_opengl
from refdgs_pipe.datasets.poses import check_shape, commonest, finite, rigid
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.files.images import read_header

_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")


@dataclass(frozen=True)
class _Entry:
    """One entry of `frames` whose photo is there; width and height in pixels of the file."""

    record: dict[str, Any]
    photo: Path
    mask: Path | None
    width: int
    height: int


def posed_frames(
    path: Path,
    root: Path,
    shared: dict[str, Any],
    *,
    undo: F64 | None = None,
) -> tuple[list[Frame], list[Skipped]]:
    """Every frame of a transforms JSON, without name and split, and what is missing.

    Args:
        path: the JSON; root: what its `file_path`s start from.
        shared: its settings for all frames; those of a frame come first.
        undo: (4, 4) applied to the camera-to-world matrices first.

    Raises:
        InputError: no focal length, a lens that cannot be undone, or a pose that is none.
    """
    entries, skipped = _entries(path, root)
    usual = commonest([(entry.width, entry.height) for entry in entries])
    frames = []
    for entry in entries:
        settings = {**shared, **entry.record}
        named = "w" in settings and "h" in settings
        try:
            expected = (float(settings["w"]), float(settings["h"])) if named else usual
            assert expected is not None  # there is an entry
            whose = "the JSON speaks of" if named else "most others are"
            check_shape((entry.width, entry.height), expected, whose=whose)
        except CaptureError as error:
            skipped.append(Skipped(str(entry.record["file_path"]), str(error)))
            continue
        except (TypeError, ValueError):
            raise InputError(f"{path}: w and h must be pixels, as numbers") from None
        where = f"{path}: transform_matrix of {entry.record['file_path']}"
        world_from_cam = finite(where, _matrix(path, entry.record))
        if undo is not None:
            world_from_cam = undo @ world_from_cam
        pose = opencv_from_opengl(rigid(where, world_from_cam))
        frames.append(
            Frame(
                entry.photo,
                mask=entry.mask,
                mask_kind="drawn" if "mask_path" in entry.record else "alpha",
                known=KnownPose(_lens(path, settings, entry.width, entry.height), pose),
            )
        )
    return frames, skipped


def _entries(path: Path, root: Path) -> tuple[list[_Entry], list[Skipped]]:
    entries, skipped = [], []
    for record in read_frames(path):
        photo, mask = frame_files(root, record)
        try:
            if photo is None:
                raise CaptureError("named in the JSON but not there")
            header = read_header(photo)
        except CaptureError as error:
            skipped.append(Skipped(str(record["file_path"]), str(error)))
            continue
        entries.append(_Entry(record, photo, mask, header.width, header.height))
    return entries, skipped


def _lens(path: Path, record: dict[str, Any], width: int, height: int) -> Lens:
    """The lens in pixels of the file, which may be smaller than the one the JSON speaks of."""
    model = record.get("camera_model", "OPENCV")
    if model not in _MODELS:
        raise InputError(f"{path}: camera_model {model} is not supported: undistort the photos")
    try:
        w, h = float(record.get("w", width)), float(record.get("h", height))
        if "fl_x" in record:
            fx = float(record["fl_x"])
        else:
            fx = w / 2 / math.tan(float(record["camera_angle_x"]) / 2)
        fy = float(record.get("fl_y", fx))
        K = np.array(
            [[fx, 0, record.get("cx", w / 2)], [0, fy, record.get("cy", h / 2)], [0, 0, 1]], float
        )
        K[:2] *= [[width / w], [height / h]]
        distortion = np.array([float(record.get(key, 0.0)) for key in _DISTORTION])
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"{path}: needs fl_x or camera_angle_x as numbers ({error})") from None
    if not (np.isfinite(K).all() and np.isfinite(distortion).all() and min(fx, fy) > 0):
        raise InputError(f"{path}: the lens is not one of finite numbers with fl_x above 0")
    return Lens(K, distortion)


def _matrix(path: Path, record: dict[str, Any]) -> F64:
    """(4, 4) camera-to-world of one frame, OpenGL."""
    matrix = np.array(record.get("transform_matrix"), dtype=object)
    try:
        if matrix.shape not in ((3, 4), (4, 4)):
            raise ValueError
        return np.vstack([matrix[:3].astype(float), [0.0, 0.0, 0.0, 1.0]])
    except (TypeError, ValueError):
        named = record["file_path"]
        raise InputError(
            f"{path}: {named} has no 4 x 4 transform_matrix of numbers. Export the poses again"
        ) from None
