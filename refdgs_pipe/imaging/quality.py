"""Figures that tell a blurred or badly exposed photo from the others of its set."""

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.color import linear_from_srgb

F32 = NDArray[np.float32]

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


def blurred(sharpness: list[float]) -> list[int]:
    """Indices of the photos that are far less sharp than their set: four robust sigmas in log."""
    logs = np.log(np.maximum(sharpness, 1e-6))
    median = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - median)))
    limit = median - max(4 * spread, float(np.log(3.0)))
    return [int(i) for i in np.flatnonzero(logs < limit)]
