"""nerfstudio and instant-ngp: one transforms.json with the lens and a pose for every photo."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from refdgs_pipe.artifacts.capture import Frame, Layout, named_frames, read_transforms
from refdgs_pipe.artifacts.views import Skipped
from refdgs_pipe.camera import F64
from refdgs_pipe.datasets.transforms import posed_frames
from refdgs_pipe.errors import InputError


def read_nerfstudio(layout: Layout) -> tuple[list[Frame], list[Skipped]]:
    """Every frame with its pose in the frame before `applied_transform`, and what is missing.

    Raises:
        InputError: the JSON is damaged, tells no focal length, or a lens that cannot be undone.
    """
    path = layout.model[0]
    shared = read_transforms(path)
    tests = {Path(str(name)).name for name in _list(shared.get("test_filenames"))}
    undo = _undo_applied(path, shared)
    found, skipped = posed_frames(path, layout.root, shared, undo=undo)
    frames = [replace(f, split="test" if f.path.name in tests else "train") for f in found]
    return named_frames(layout.root, frames), skipped


def _undo_applied(path: Path, shared: dict[str, Any]) -> F64:
    """(4, 4) from the JSON's world back to the one before nerfstudio turned and scaled it."""
    out = np.eye(4)
    try:
        given = np.array(shared.get("applied_transform", out[:3]), float)
        scale = float(shared.get("applied_scale", 1.0))
    except (TypeError, ValueError):
        raise InputError(f"{path}: applied_transform and applied_scale must be numbers") from None
    if not (np.isfinite(given).all() and np.isfinite(scale) and scale > 0):
        raise InputError(f"{path}: applied_transform or applied_scale is not finite, or is 0")
    if given.shape not in ((3, 4), (4, 4)) or abs(np.linalg.det(given[:3, :3])) < 1e-9:
        raise InputError(f"{path}: applied_transform is not an invertible 3 x 4 matrix")
    out[:3] = given[:3]
    return np.asarray(np.linalg.inv(out) @ np.diag([1 / scale, 1 / scale, 1 / scale, 1.0]))


def _list(value: object) -> list[object]:
    return value if isinstance(value, list) else []
