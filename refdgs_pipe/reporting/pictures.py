"""Pixels to small pictures that a page can hold: data URIs, thumbnails, maps in false colours."""

import base64
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.color import srgb_from_linear

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]
ERROR_FULL = 0.2  # the error, of [0, 1], that has the brightest colour

_QUALITY = 82


def data_uri(content: bytes, mime: str) -> str:
    """Bytes as an address that needs no file."""
    return f"data:{mime};base64,{base64.b64encode(content).decode('ascii')}"


def webp(pixels: U8, quality: int = _QUALITY) -> str:
    """A picture (H, W), (H, W, 3) RGB or (H, W, 4) RGBA as a data URI."""
    if pixels.ndim == 3:
        order = [2, 1, 0, 3][: pixels.shape[2]]
        pixels = pixels[..., order]
    done, content = cv2.imencode(
        ".webp", np.ascontiguousarray(pixels), [cv2.IMWRITE_WEBP_QUALITY, quality]
    )
    assert done
    return data_uri(content.tobytes(), "image/webp")


def eight_bits(values: F32) -> U8:
    """[0, 1] to 0..255."""
    return np.round(np.clip(np.nan_to_num(values), 0, 1) * 255).astype(np.uint8)


def fitted(pixels: NDArray[Any], longest: int) -> NDArray[Any]:
    """A picture whose longer side is at most so many pixels."""
    height, width = pixels.shape[:2]
    scale = longest / max(height, width)
    if scale >= 1:
        return pixels
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))


def thumbnail(path: Path, longest: int, *, linear: bool, mask: Path | None = None) -> U8:
    """A photo of the workspace, small: (h, w, 3), or (h, w, 4) with its mask as alpha.

    Args:
        linear: the file holds linear light.
    """
    from refdgs_pipe.files.images import read_png

    parts = [_unit(fitted(read_png(path), longest))]
    if linear:
        parts[0] = srgb_from_linear(parts[0])
    if mask is not None:
        height, width = parts[0].shape[:2]
        alpha = np.asarray(cv2.resize(_unit(read_png(mask)), (width, height)), np.float32)
        parts.append(alpha[..., None])
    return eight_bits(np.concatenate(parts, -1))


def error_map(image: F32, target: F32, valid: NDArray[np.bool_]) -> U8:
    """(H, W, 3) mean absolute difference of the channels, black to bright; grey where unknown."""
    difference = np.abs(image - target).mean(-1) / ERROR_FULL
    colors = cv2.applyColorMap(eight_bits(difference.astype(np.float32)), cv2.COLORMAP_INFERNO)
    return np.where(valid[..., None], colors[..., ::-1], np.uint8(128))


def with_alpha(values: F32, alpha: F32) -> U8:
    """(H, W, 4) a map over nothing, so that the page's own colour is behind it.

    Args:
        values: (H, W) or (H, W, 3) in [0, 1].
    """
    rgb = values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2)
    return eight_bits(np.concatenate([rgb, alpha[..., None]], -1))


def _unit(pixels: NDArray[Any]) -> F32:
    full = float(np.iinfo(pixels.dtype).max)
    return np.asarray(pixels.astype(np.float32) / full, np.float32)
