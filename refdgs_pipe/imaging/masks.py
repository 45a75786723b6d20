"""Object masks as users bring them: which file belongs to which photo, and which way round."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.images import read_photo

U8 = NDArray[np.uint8]


def find_masks(folder: Path, photos: Iterable[tuple[Path, str]]) -> dict[Path, Path]:
    """photo -> its mask: NAME.png, NAME.jpg.png, any case, in the same sub-folder or flat.

    Args:
        photos: each path with its name relative to the capture.
    """
    files = {
        p.relative_to(folder).as_posix().lower(): p
        for p in sorted(folder.rglob("*"))
        if p.is_file() and not p.name.startswith(".")
    }
    stems = {name.rsplit(".", 1)[0]: path for name, path in reversed(files.items())}
    found = {}
    for path, source in photos:
        whole = source.lower()
        stem, flat = whole.rsplit(".", 1)[0], path.name.lower()
        keys = (whole, stem, flat, flat.rsplit(".", 1)[0])
        match = next((stems[key] for key in keys if key in stems), None)
        if match is not None:
            found[path] = match
    return found


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
