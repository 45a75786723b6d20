"""NeRF-synthetic and Shiny Blender: transforms_train.json and transforms_test.json."""

import math
from pathlib import Path

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
from refdgs_pipe.camera import Lens, opencv_from_opengl
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.files.images import read_header


def read_blender(layout: Layout) -> tuple[list[Frame], list[Skipped]]:
    """Every frame of both splits with its pose, and what is missing.

    Raises:
        InputError: a JSON is damaged or lacks `camera_angle_x`.
    """
    found: list[tuple[Path, Path | None, str, KnownPose | None]] = []
    skipped = []
    for model in layout.model:
        split = "test" if model.stem.endswith("test") else "train"
        angle = read_transforms(model).get("camera_angle_x")
        if not isinstance(angle, float) or not 0 < angle < math.pi:
            raise InputError(f"{model}: camera_angle_x is {angle}, expected radians in (0, pi)")
        for record in read_frames(model):
            photo, _ = frame_files(layout.root, record)
            try:
                if photo is None:
                    raise CaptureError("named in the JSON but not there")
                header = read_header(photo)
            except CaptureError as error:
                skipped.append(Skipped(str(record["file_path"]), str(error)))
                continue
            lens = _lens(angle, header.width, header.height)
            matrix = np.array(record["transform_matrix"], float)
            found.append((photo, None, split, KnownPose(lens, opencv_from_opengl(matrix))))
    return named_frames(layout.root, found), skipped


def _lens(angle: float, width: int, height: int) -> Lens:
    focal = width / 2 / math.tan(angle / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Lens(K, np.zeros(8))
