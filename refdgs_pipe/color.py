"""Pixels as numbers, and the sRGB transfer curve (IEC 61966-2-1)."""

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]


def fractions(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> F32:
    """Whole numbers of 8 or 16 bits as 0 to 1."""
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def srgb_from_linear(linear: F32) -> F32:
    """Encode linear light. Values are clipped to [0, 1] first."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(
        x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-9), 1 / 2.4) - 0.055
    ).astype(np.float32)


def linear_from_srgb(srgb: F32) -> F32:
    """Decode to linear light. Values are clipped to [0, 1] first."""
    x = np.clip(srgb, 0.0, 1.0)
    return np.where(x <= 0.04045, x / 12.92, np.power((x + 0.055) / 1.055, 2.4)).astype(np.float32)


def srgb_slope(linear: F32) -> F32:
    """How fast the sRGB code rises with linear light; 0 where it is clipped."""
    x = np.clip(linear, 2e-3, 1)
    slope = np.where(x <= 0.0031308, 12.92, 1.055 / 2.4 * x ** (1 / 2.4 - 1))
    return np.where(linear < 1, slope, 0).astype(np.float32)
