"""Object masks as users bring them: which file belongs to which photo, and which way round."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.capture import Frame
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.images import read_photo

U8 = NDArray[np.uint8]


def with_masks(frames: list[Frame], folder: Path | None) -> list[Frame]:
    """The frames with their masks from a folder: NAME.png or NAME.jpg.png, in any case.

    Masks may lie flat or in the sub-folders of the photos. What a frame has already it keeps.
    """
    if folder is None:
        return frames
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not path.name.startswith("."):
            found.setdefault(_stem(path.relative_to(folder).as_posix()), path)
    out = []
    for frame in frames:
        whole, flat = frame.source.lower(), frame.path.name.lower()
        keys = (whole, _stem(whole), flat, _stem(flat))
        mask = frame.mask or next((found[key] for key in keys if key in found), None)
        out.append(replace(frame, mask=mask))
    return out


def _stem(name: str) -> str:
    return name.lower().rsplit(".", 1)[0]


def read_mask(path: Path, *, inverted: bool = False) -> U8:
    """A mask file as (H, W) uint8, white is object. An alpha channel counts if the colour is plain.

    Raises:
        CaptureError: not an image, or all black, or all white.
    """
    pixels = read_photo(path, upright=False)
    if pixels.dtype == np.uint16:
        pixels = (pixels >> 8).astype(np.uint8)
    gray = pixels[..., :3].max(axis=2)
    if pixels.shape[2] == 4 and gray.min() == gray.max():
        gray = pixels[..., 3]
    mask = np.ascontiguousarray(255 - gray if inverted else gray).astype(np.uint8)
    if mask.max() > mask.min() and mask.max() <= 1:
        mask = (mask * 255).astype(np.uint8)  # written as 0 and 1
    check_mask(mask, f"masks/{path.name}")
    return mask


def check_mask(mask: U8, name: str) -> None:
    """Refuse a mask that marks nothing, or everything.

    Raises:
        CaptureError: all black, or all white.
    """
    share = float((mask >= 128).mean())
    if share == 0.0:
        raise CaptureError(f"{name} is all black: it marks no object. Redo the mask or delete it")
    if share == 1.0:
        raise CaptureError(f"{name} is all white: it masks nothing. Redo the mask or delete it")


def are_inverted(masks: Iterable[U8]) -> bool:
    """Whether black marks the object: in most masks the photo's rim is whiter than its middle."""
    votes = []
    for mask in masks:
        small = np.asarray(cv2.resize(mask, (64, 64), interpolation=cv2.INTER_AREA), float)
        middle = small[16:48, 16:48].mean()
        rim = np.concatenate([small[:3].ravel(), small[-3:].ravel(), small[:, :3].ravel()]).mean()
        votes.append(rim > middle)
    return bool(votes) and sum(votes) > len(votes) / 2
