"""How far a picture or a normal map is from the truth."""

import math

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]


def psnr(image: F32, target: F32) -> float:
    """Peak signal-to-noise ratio in dB over all pixels and channels of images in [0, 1]."""
    error = float(np.mean((image.astype(np.float64) - target) ** 2))
    return -10 * math.log10(max(error, 1e-12))


def normal_error_deg(normal: F32, truth: F32, mask: NDArray[np.bool_]) -> float:
    """Mean angle in degrees between (H, W, 3) unit normals, over the pixels of the mask."""
    cosine = np.clip((normal * truth).sum(-1)[mask].astype(np.float64), -1, 1)
    return float(np.degrees(np.arccos(cosine)).mean())
