"""Training photos in memory, at every scale of the run."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.ops import Pinhole


@dataclass(frozen=True)
class TrainingPhoto:
    """One photo at one scale, compact in memory.

    Args:
        camera: at this scale; pinhole: the same for the rasteriser.
        rgb: (3, H, W) uint8 sRGB, straight.
        mask: (H, W) uint8, or None.
        valid: (H, W) bool, or None when all are.
    """

    camera: Camera
    pinhole: Pinhole
    rgb: Tensor
    mask: Tensor | None
    valid: Tensor | None


def load_training_photos(
    views: Views, model: SparseModel, *, max_side: int, near: float
) -> list[TrainingPhoto]:
    """All photos of the train split, no larger than `max_side` pixels."""
    cameras = [camera for camera in model.cameras if camera.split == "train"]
    photos = []
    for camera in cameras:
        scale = min(1.0, max_side / max(camera.width, camera.height))
        photo = load_photo(views, model, camera, scale=scale)
        rgb = _bytes(photo.rgb).transpose(2, 0, 1)
        mask = None if photo.mask is None else torch.from_numpy(_bytes(photo.mask))
        valid = None if photo.valid.all() else torch.from_numpy(photo.valid)
        pinhole = Pinhole.of(photo.camera, near)
        rgb_tensor = torch.from_numpy(np.ascontiguousarray(rgb))
        photos.append(TrainingPhoto(photo.camera, pinhole, rgb_tensor, mask, valid))
    return photos


def shrunk(photo: TrainingPhoto, scale: float) -> TrainingPhoto:
    """The photo resampled to a smaller scale."""
    if scale >= 1:
        return photo
    width = max(16, round(photo.camera.width * scale))
    height = max(16, round(photo.camera.height * scale))
    rgb: NDArray[np.float32] = photo.rgb.permute(1, 2, 0).float().numpy()
    mask = None if photo.mask is None else photo.mask.numpy().astype(np.float32)
    if mask is not None:
        rgb = rgb * (mask[..., None] / np.float32(255))
    rgb = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
    small = None
    if mask is not None:
        mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_AREA)
        rgb = np.divide(
            rgb, mask[..., None] / 255, out=np.zeros_like(rgb), where=mask[..., None] > 0.5
        )
        small = torch.from_numpy(np.rint(mask).astype(np.uint8))
    valid = None
    if photo.valid is not None:
        grown = cv2.resize(
            photo.valid.numpy().astype(np.float32), (width, height), interpolation=cv2.INTER_AREA
        )
        valid = torch.from_numpy(grown > 0.999)
    camera = photo.camera.resized(width, height)
    pixels = np.ascontiguousarray(np.rint(rgb.clip(0, 255)).astype(np.uint8).transpose(2, 0, 1))
    pinhole = Pinhole.of(camera, photo.pinhole.near)
    return TrainingPhoto(camera, pinhole, torch.from_numpy(pixels), small, valid)


def composited(photo: TrainingPhoto, backdrop: Tensor) -> Tensor:
    """(H, W, 3) float target over a backdrop (3,); photos without a mask as they are."""
    rgb = photo.rgb.permute(1, 2, 0).float() / 255
    if photo.mask is None:
        return rgb
    m = (photo.mask.float() / 255)[..., None]
    return rgb * m + (1 - m) * backdrop


def _bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(image.clip(0, 1) * 255), np.uint8)
