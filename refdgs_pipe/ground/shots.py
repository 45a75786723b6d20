"""Photos at a working size, cut to where the object can be."""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Box, Camera

F32 = NDArray[np.float32]
Bools = NDArray[np.bool_]

T = TypeVar("T")
S = TypeVar("S")

LOG_FLOOR = 0.02  # keeps the logarithm of black finite; about five 8-bit levels


@dataclass(frozen=True)
class Shot:
    """A part of a photo.

    Args:
        camera: of the part; its principal point counts from the part's corner.
        rgb: (H, W, 3) sRGB in [0, 1].
        valid: (H, W) false where the undistorted photo has no source.
        box: where the part lies in `whole`.
        whole: width and height of the photo that it was cut from.
    """

    camera: Camera
    rgb: F32
    valid: Bools
    box: Box
    whole: tuple[int, int]

    @property
    def logs(self) -> F32:
        """(H, W, 3) logarithms of the colour, in which a brighter light is a shift."""
        return logs_of(self.rgb)

    def placed(self, image: F32) -> F32:
        """(h, w) an image of the part in the whole photo; 0 outside."""
        out = np.zeros((self.whole[1], self.whole[0]), np.float32)
        left, right, top, bottom = self.box
        out[top:bottom, left:right] = image
        return out


def logs_of(rgb: F32) -> F32:
    """(H, W, 3) logarithms of sRGB colour in [0, 1]."""
    return np.asarray(np.log(rgb.clip(1 / 255, 1) + LOG_FLOOR), np.float32)


def whole_shots(views: Views, model: SparseModel, side: int) -> Iterator[Shot]:
    """All photos, at most `side` pixels long; one after the other, to keep few in memory."""
    for camera in model.cameras:
        scale = min(1.0, side / max(camera.width, camera.height))
        photo = load_photo(views, model, camera, scale=scale)
        height, width = photo.rgb.shape[:2]
        box = (0, width, 0, height)
        yield Shot(photo.camera, photo.rgb, photo.valid, box, (width, height))


def cut_to(shot: Shot, box: Box) -> Shot:
    """A part of a whole shot, as a copy: the whole can be freed."""
    left, right, top, bottom = box
    camera = shot.camera.part(*box)
    part = (slice(top, bottom), slice(left, right))
    return Shot(camera, shot.rgb[part].copy(), shot.valid[part].copy(), box, shot.whole)


def cut_round(shot: Shot, outline: Bools, margin: float) -> Shot:
    """The part of a photo round an outline of any size; the photo where there is none.

    Args:
        margin: a share of the longer side of the outline.
    """
    box = box_around(resized(outline.astype(np.float32), *shot.whole) > 0.5, margin)
    return shot if box is None else cut_to(shot, box)


def box_around(mask: Bools, margin: float) -> Box | None:
    """The box of a mask with a margin, a share of its larger side; None if the mask is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    left, right, top, bottom = columns[0], columns[-1] + 1, rows[0], rows[-1] + 1
    grow = max(8, round(margin * max(right - left, bottom - top)))
    height, width = mask.shape
    return (
        int(max(0, left - grow)),
        int(min(width, right + grow)),
        int(max(0, top - grow)),
        int(min(height, bottom + grow)),
    )


def resized(image: F32, width: int, height: int) -> F32:
    """(height, width) by linear interpolation."""
    return np.asarray(
        cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR), np.float32
    )


def grown(mask: Bools, reach: int) -> Bools:
    """(H, W) the mask and what lies within `reach` pixels of it; a negative reach shrinks it."""
    if reach == 0:
        return mask
    size = 2 * abs(reach) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    change = cv2.dilate if reach > 0 else cv2.erode
    return np.asarray(change(mask.astype(np.uint8), kernel) > 0)


def mapped(function: Callable[[T], S], items: Iterable[T], threads: int) -> list[S]:
    """The function of each item, in order, several at a time."""
    if threads < 2:
        return [function(item) for item in items]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(function, items))
