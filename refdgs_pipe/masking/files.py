"""Masks as files, in the photos as they were taken."""

from pathlib import Path

import cv2
import numpy as np

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.files.images import write_png
from refdgs_pipe.ground.shots import F32, resized


def write_masks(folder: Path, views: Views, model: SparseModel, masks: list[F32]) -> None:
    """Write NAME.png for every camera of the model.

    Args:
        masks: (h, w) in [0, 1] of the undistorted photos, at any size.
    """
    for camera, mask in zip(model.cameras, masks, strict=True):
        view = views[camera.name]
        large = resized(mask, camera.width, camera.height)
        lens = model.lenses[camera.name]
        if not (lens.is_pinhole and np.array_equal(lens.K, camera.K)):
            large = distorted(large, camera, lens, view.width, view.height)
        write_png(folder / f"{camera.name}.png", np.rint(255 * large.clip(0, 1)).astype(np.uint8))


def distorted(mask: F32, camera: Camera, lens: Lens, width: int, height: int) -> F32:
    """(height, width) the mask of an undistorted photo in the photo as its lens drew it."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    places = np.stack([x, y], -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(places, lens.K, lens.distortion, P=camera.K)
    grid = straight.reshape(height, width, 2).astype(np.float32) - np.float32(0.5)
    out = cv2.remap(
        mask, grid[..., 0], grid[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
    )
    return np.asarray(out, np.float32)
