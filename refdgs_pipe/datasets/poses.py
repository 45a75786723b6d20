"""Poses and photo sizes as data sets give them, checked before anything builds on them."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from refdgs_pipe.camera import F64
from refdgs_pipe.errors import CaptureError, InputError

SIZES_DIFFER = 0.01  # of width / height: reduced copies are rounded to whole pixels
_ROUNDING = 1e-5  # of a rotation written as float32 numbers

Size = tuple[float, float]


def finite(where: str, pose: F64) -> F64:
    """The pose as it is.

    Raises:
        InputError: it holds NaN or infinity; says so of `where`.
    """
    if not np.isfinite(pose).all():
        raise InputError(
            f"{where}: the pose holds NaN or infinity, expected finite numbers. "
            "Export the poses again, or take this photo out"
        )
    return pose


def rigid(where: str, pose: F64) -> F64:
    """(4, 4) of a pose (3 or 4, 4), without the scale that some exporters leave in its axes.

    Args:
        where: what the pose belongs to, for messages.

    Raises:
        InputError: it is not finite, mirrored, sheared or flat.
    """
    axes = finite(where, pose)[:3, :3]
    out = np.eye(4)
    out[:3] = pose[:3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > _ROUNDING:
        U, sizes, Vt = np.linalg.svd(axes)
        if sizes[2] < 0.99 * sizes[0] or sizes[0] == 0:
            raise InputError(f"{where}: the pose is sheared or flat, not a camera's")
        out[:3, :3] = U @ Vt
    if np.linalg.det(out[:3, :3]) < 0:
        raise InputError(f"{where}: the pose is mirrored, not a camera's")
    return out


def commonest(sizes: Sequence[Size]) -> Size | None:
    """The size (width, height) that most photos have; None without photos."""
    return Counter(sizes).most_common(1)[0][0] if sizes else None


def check_shape(size: Size, expected: Size, *, whose: str) -> None:
    """Refuse a photo that is neither of the expected size nor a reduced copy of it.

    Args:
        size, expected: width and height in pixels.
        whose: who is of the expected size, for the message.

    Raises:
        CaptureError: width / height differ.
    """
    (width, height), (w, h) = size, expected
    if abs(width * h - w * height) > SIZES_DIFFER * width * h:
        raise CaptureError(
            f"is {width:g} x {height:g} but {whose} {w:g} x {h:g}: their shapes must agree. "
            "Use the photo as it was when the poses were found"
        )
