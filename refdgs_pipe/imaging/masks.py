"""Object masks as users bring them: which file belongs to which photo, and which way round."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.capture import Frame
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.images import Pixels, read_photo
from refdgs_pipe.files.kinds import is_candidate
from refdgs_pipe.formatting import printable

U8 = NDArray[np.uint8]

NERO_DEPTH = 15.0  # world units at the white of a depth map
NERO_BACKGROUND = 14.5  # world units; from here on there is no object


def with_masks(
    frames: list[Frame], folders: tuple[Path, ...], root: Path
) -> tuple[list[Frame], list[str]]:
    """The frames with their masks from folders: NAME.png or NAME.jpg.png, in any case.

    Masks may lie flat, in the sub-folders of the photos, or in a folder of masks beside each
    folder of photos. What a frame has already it keeps.

    Args:
        root: the folder that the frames' sources start from.

    Returns:
        The frames, and the names of the masks that belong to none of them.
    """
    found: dict[str, Path] = {}
    files: dict[Path, str] = {}
    for folder in folders:
        beside = folder.parent.relative_to(root) if folder.parent.is_relative_to(root) else Path()
        for path in sorted(folder.rglob("*")):
            if path.is_file() and not path.name.startswith(".") and is_candidate(path):
                key = _stem(printable((beside / path.relative_to(folder)).as_posix()))
                found.setdefault(key, path)
                files[path] = printable(path.relative_to(folder.parent).as_posix())
    out = []
    for frame in frames:
        whole, flat = frame.source.lower(), printable(frame.path.name).lower()
        keys = (whole, _stem(whole), flat, _stem(flat))
        mask = frame.mask or next((found[key] for key in keys if key in found), None)
        kind = frame.mask_kind if frame.mask else "drawn"
        out.append(replace(frame, mask=mask, mask_kind=kind))
    used = {frame.mask for frame in out}
    return out, [name for path, name in files.items() if path not in used]


def _stem(name: str) -> str:
    return name.lower().rsplit(".", 1)[0]


def read_mask(path: Path, *, inverted: bool = False) -> U8:
    """A mask file as (H, W) uint8, white is object. An alpha channel counts if the colour is plain.

    Raises:
        CaptureError: not an image, or all black, or all white.
    """
    pixels = _uint8(read_photo(path, upright=False, is_mask=True))
    gray = pixels[..., :3].max(axis=2)
    if pixels.shape[2] == 4 and gray.min() == gray.max():
        gray = pixels[..., 3]
    mask = np.ascontiguousarray(255 - gray if inverted else gray).astype(np.uint8)
    if mask.max() > mask.min() and mask.max() <= 1:
        mask = (mask * 255).astype(np.uint8)  # written as 0 and 1
    check_mask(mask, f"masks/{path.name}")
    return mask


def read_alpha(path: Path) -> U8:
    """An alpha channel in a file of its own as (H, W) uint8, white is object.

    Raises:
        CaptureError: not an image, or all black, or all white.
    """
    pixels = read_photo(path, upright=False, is_mask=True)
    alpha = _uint8(pixels)[..., :3].max(axis=2)
    check_mask(alpha, path.name)
    return np.ascontiguousarray(alpha)


def read_depth_mask(path: Path) -> U8:
    """The mask (H, W) uint8 that NeRO's depth gives: object nearer than 14.5 world units.

    Raises:
        CaptureError: not a 16-bit image, or all object, or none.
    """
    pixels = read_photo(path, upright=False, is_mask=True)
    if pixels.dtype != np.uint16:
        raise CaptureError(f"{path.name}: expected a 16-bit PNG, found 8 bits. Copy it again")
    depth = pixels[..., 0].astype(np.float32) / 65535 * NERO_DEPTH
    mask = np.where(depth < NERO_BACKGROUND, 255, 0).astype(np.uint8)
    check_mask(mask, f"the mask by {path.name}")
    return mask


def without_matte(rgb: Pixels, alpha: U8) -> Pixels:
    """Straight colour of a picture over white or black, whose alpha came in a file of its own.

    Where the picture is not plain white (or black) behind the object, it is taken to be straight.

    Args:
        rgb: (H, W, 3); alpha: (H, W).
    """
    full = float(np.iinfo(rgb.dtype).max)
    color, a = rgb.astype(np.float32) / full, alpha[..., None].astype(np.float32) / 255
    behind = color[alpha == 0]
    if len(behind) and (behind == 1).all():
        matte = 1.0
    elif len(behind) and (behind == 0).all() and (color <= a + 1.5 / 255).all():
        matte = 0.0
    else:
        return rgb
    straight = (color - (1 - a) * matte) / np.maximum(a, 1 / 255)
    levels = (np.clip(np.where(a > 0, straight, matte), 0, 1) * full).round()
    return levels.astype(np.uint16) if rgb.dtype == np.uint16 else levels.astype(np.uint8)


def _uint8(pixels: Pixels) -> U8:
    return (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels.astype(np.uint8)


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
