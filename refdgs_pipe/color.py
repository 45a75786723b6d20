"""The sRGB transfer curve (IEC 61966-2-1)."""

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]


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
