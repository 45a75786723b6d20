"""Photos as the cameras of a sparse model see them: undistorted, sRGB, at any smaller size."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.color import fractions, linear_from_srgb, srgb_from_linear
from refdgs_pipe.files.images import read_png

F32 = NDArray[np.float32]


@dataclass(frozen=True)
class Photo:
    """One photo, aligned with `camera`.

    Args:
        rgb: (H, W, 3) sRGB-encoded in [0, 1]; straight, not premultiplied by the mask.
        mask: (H, W) how much of the pixel is object, or None.
        valid: (H, W) false where the undistorted photo has no source.
    """

    camera: Camera
    rgb: F32
    mask: F32 | None
    valid: NDArray[np.bool_]

    def framed(self, center: NDArray[np.float64], radius: float) -> "Photo":
        """The part within `Camera.frame`."""
        left, right, top, bottom = box = self.camera.frame(center, radius)
        part = (slice(top, bottom), slice(left, right))
        mask = None if self.mask is None else self.mask[part]
        return Photo(self.camera.part(*box), self.rgb[part], mask, self.valid[part])

    def alone(self) -> F32:
        """(H, W, 3) the pixels that show the object and nothing else, or the photo; else NaN."""
        shown = self.valid if self.mask is None else self.valid & (self.mask > 0.999)
        return np.where(shown[..., None], self.rgb, np.float32(np.nan))


def load_photo(
    views: Views,
    model: SparseModel,
    camera: Camera,
    *,
    scale: float = 1.0,
    evened: bool = True,
) -> Photo:
    """Read the photo of a camera of the model.

    Args:
        scale: size of the result relative to the camera's; at most 1.
        evened: with the model's factor for its exposure and white balance.

    Raises:
        CorruptError: the image or its mask is missing or damaged.
    """
    view = views[camera.name]
    rgb = fractions(read_png(views.image_path(view)))
    mask_path = views.mask_path(view)
    mask = None if mask_path is None else _mask(mask_path, rgb)
    valid = np.ones(rgb.shape[:2], np.float32)
    if views.background == "removed" and mask is not None:
        rgb = rgb * mask[..., None]  # resampling mixes premultiplied colour
    lens = model.lenses[camera.name]
    if not (lens.is_pinhole and np.array_equal(lens.K, camera.K)):
        grid = _undistortion(lens, camera)
        rgb, valid = _remap(rgb, grid), _remap(valid, grid)
        mask = None if mask is None else _remap(mask, grid)
    size = (max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    if size != (camera.width, camera.height):
        rgb, valid = _shrink(rgb, size), _shrink(valid, size)
        mask = None if mask is None else _shrink(mask, size)
    if views.background == "removed" and mask is not None:
        rgb = np.divide(rgb, mask[..., None], out=np.zeros_like(rgb), where=mask[..., None] > 1e-3)
    gain = model.gains.get(camera.name) if evened else None
    if gain is not None:
        linear = rgb if views.color_space == "linear" else linear_from_srgb(np.clip(rgb, 0, 1))
        rgb = srgb_from_linear(linear * np.array(gain, np.float32))
    elif views.color_space == "linear":
        rgb = srgb_from_linear(rgb)
    rgb = np.clip(rgb, 0, 1)
    return Photo(camera.resized(*size), rgb, mask, valid > 0.999)


def _mask(path: Path, rgb: F32) -> F32:
    """(H, W) a mask at its photo's size; one that a user brought may be coloured or smaller."""
    mask = fractions(read_png(path))
    plain = mask if mask.ndim == 2 else mask[..., :3].max(axis=2)
    if plain.shape != rgb.shape[:2]:
        size = (rgb.shape[1], rgb.shape[0])
        plain = np.asarray(cv2.resize(plain, size, interpolation=cv2.INTER_LINEAR), np.float32)
    return np.ascontiguousarray(plain)


def _undistortion(lens: Lens, camera: Camera) -> tuple[F32, F32]:
    """Where in the photo each pixel of the pinhole camera comes from, in OpenCV's pixel indices.

    OpenCV puts the centre of pixel 0 at 0, we at 0.5.
    """
    shift = np.zeros((3, 3))
    shift[:2, 2] = 0.5
    grid = cv2.initUndistortRectifyMap(
        lens.K - shift,
        lens.distortion,
        None,
        camera.K - shift,
        (camera.width, camera.height),
        cv2.CV_32FC1,
    )
    return np.asarray(grid[0], np.float32), np.asarray(grid[1], np.float32)


def _remap(image: F32, grid: tuple[F32, F32]) -> F32:
    out = cv2.remap(image, *grid, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(out, np.float32)


def _shrink(image: F32, size: tuple[int, int]) -> F32:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float32)
