"""Figures that tell a blurred or badly exposed photo from the others of its set."""

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.color import linear_from_srgb, srgb_from_linear
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.images import Pixels

F32 = NDArray[np.float32]

SMALLEST = 64  # px of the long side
SCALE = 800  # px: sharpness of photos of different sizes compares at this long side


def sharpness_and_exposure(rgb: F32) -> tuple[float, float]:
    """Variance of the Laplacian (8-bit levels squared) and mean linear luminance.

    Args:
        rgb: (H, W, 3) sRGB-encoded in [0, 1].
    """
    height, width = rgb.shape[:2]
    scale = min(1.0, SCALE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.float32)
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY) * 255.0
    weights = np.array([0.2126, 0.7152, 0.0722], np.float32)
    luminance = float((linear_from_srgb(small) @ weights).mean())
    return float(cv2.Laplacian(gray, cv2.CV_32F).var()), luminance


def check_picture(pixels: Pixels, name: str, *, linear: bool) -> None:
    """Refuse a picture (H, W, C) that shows nothing.

    Raises:
        CaptureError: smaller than 64 pixels, all black, all white, or of one colour.
    """
    height, width = pixels.shape[:2]
    if max(height, width) < SMALLEST:
        raise CaptureError(
            f"{name}: only {width} x {height} pixels; at least {SMALLEST} on the long side are "
            "needed. Is it a thumbnail?"
        )
    size = (min(width, 256), min(height, 256))
    small = cv2.resize(pixels[..., :3], size, interpolation=cv2.INTER_AREA)
    unit = small.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    levels = (srgb_from_linear(unit) if linear else unit) * 255
    low, high = np.percentile(levels, (0.1, 99.9), axis=(0, 1))
    if high.max() < 4:
        raise CaptureError(f"{name} is all black: was the lens covered? Leave it out")
    if low.min() > 251:
        raise CaptureError(f"{name} is all white: it was exposed too long. Leave it out")
    if (high - low).max() < 3:
        raise CaptureError(f"{name} is of one colour: it shows nothing. Leave it out")


def blurred(sharpness: list[float]) -> list[int]:
    """Indices of the photos that are far less sharp than their set: four robust sigmas in log."""
    logs = np.log(np.maximum(sharpness, 1e-6))
    median = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - median)))
    limit = median - max(4 * spread, float(np.log(3.0)))
    return [int(i) for i in np.flatnonzero(logs < limit)]
