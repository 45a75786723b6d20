"""Shifts between a photo and what the asset shows there, smooth over the photo.

Poses and mesh are right to about a pixel of a photo at full size. Print of two photos then lies a
pixel or two apart. The shift is found by the method of Lucas and Kanade (1981) with Gaussian
windows, from coarse to fine; where nothing tells it, it is that of the places beside.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]

_BLURS = (4.0, 4.0, 2.0, 2.0, 1.0, 1.0)  # pixels (sigma), round by round
_WINDOW = 12.0  # pixels (sigma) over which one shift is found
_STEP = 4  # pixels between places whose shifts are found
_DAMPING = 2e-4  # of the squared gradient: weaker texture tells no shift
_FARTHEST = 6.0  # pixels


def shifts(shown: F32, photo: F32, known: F32) -> F32:
    """(H, W, 2) by how many columns and rows the photo lies beside what is shown.

    Args:
        shown: (H, W) what the asset shows; photo: (H, W) the same in the photo; both without slow
            changes, about 1 for white.
        known: (H, W) 0 to 1, where both count.
    """
    height, width = shown.shape
    flow = np.zeros((height, width, 2), np.float32)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    few = (max(1, width // _STEP), max(1, height // _STEP))
    for blur in _BLURS:
        soft, other = (cv2.GaussianBlur(v, (0, 0), blur) for v in (shown, photo))
        across = cv2.Sobel(soft, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8) * known
        down = cv2.Sobel(soft, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8) * known
        there = cv2.remap(other, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)
        apart = soft - there
        terms = [across * across, across * down, down * down, across * apart, down * apart]
        small = [cv2.resize(term, few, interpolation=cv2.INTER_AREA) for term in terms]
        a, b, c, u, v = (cv2.GaussianBlur(term, (0, 0), _WINDOW / _STEP) for term in small)
        a, c = a + np.float32(_DAMPING), c + np.float32(_DAMPING)
        step = np.stack([c * u - b * v, a * v - b * u], -1) / (a * c - b * b)[..., None]
        step = cv2.GaussianBlur(np.clip(step, -2, 2), (0, 0), _WINDOW / 2 / _STEP)
        flow += cv2.resize(step, (width, height), interpolation=cv2.INTER_LINEAR)
        flow = np.clip(flow, -_FARTHEST, _FARTHEST)
    return np.asarray(flow, np.float32)
