"""Training photos in memory, at every scale of the run."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import TrainingError
from refdgs_pipe.ops import Pinhole

MARGIN = 0.06  # on each side of the object in a cropped photo, of its width or height
FILL = 0.55  # width of the object's ball in a usual photo, beside the photo's longer side
STEPS = 4  # sides of crops are whole multiples of max_side / STEPS: a GPU records steps by size
TENSORS = ("rgb", "mask", "valid", "held", "which", "beyond")


@dataclass(frozen=True)
class TrainingPhoto:
    """One photo at one scale, compact in memory.

    Args:
        camera: at this scale; pinhole: the same for the rasteriser.
        rgb: (3, H, W) uint8 sRGB, straight.
        mask: (H, W) uint8, or None.
        valid: (H, W) bool, or None when all are.
        held: (2, K) rows and columns of pixels that are measured and never trained on, or None.
        beyond: (H, W) bool where the object is known not to be although there is no mask, or None.
        which: (P,) 1 at the photo's place among P whose exposures are fitted, 0 elsewhere; or None.
        frame: height of a usual photo that shows the object as large, pixels; None: its own height.
    """

    camera: Camera
    pinhole: Pinhole
    rgb: Tensor
    mask: Tensor | None
    valid: Tensor | None
    held: Tensor | None = None
    which: Tensor | None = None
    beyond: Tensor | None = None
    frame: float | None = None

    @property
    def lever(self) -> float:
        """Factor from a gradient of this photo's loss to the one that densification compares.

        The first is per pixel, of a mean over the pixels of this photo. The second is per half the
        frame's width, of a mean over the pixels of the frame.
        """
        height = self.camera.height if self.frame is None else self.frame
        return self.camera.width * self.camera.height / (2 * height)

    def to(self, device: str) -> "TrainingPhoto":
        """The photo with its pixels on a device; the camera stays."""
        return self.each(lambda pixels: pixels.to(device))

    def each(self, change: Callable[[Tensor], Tensor]) -> "TrainingPhoto":
        """The photo with every tensor that it has changed; the camera stays."""
        changed: dict[str, Any] = {}
        for name in TENSORS:
            if (tensor := getattr(self, name)) is not None:
                changed[name] = change(tensor)
        return replace(self, **changed)


def load_training_photos(
    views: Views, model: SparseModel, *, max_side: int, near: float, framed: bool = False
) -> list[TrainingPhoto]:
    """All photos of the train split, reduced to `max_side` pixels.

    Args:
        max_side: of a whole photo, pixels.
        near: see `Pinhole`.
        framed: cut each photo to the object, by its mask. Photos that show it small are reduced
            less, so that it is as large as in a usual photo of `max_side` pixels.

    Raises:
        TrainingError: there are none.
    """
    from refdgs_pipe.artifacts.photos import load_photo

    cameras = [camera for camera in model.cameras if camera.split == "train"]
    if not cameras:
        raise TrainingError("no photo is left to train on: every view is held out or lost")
    photos, frames = [], []
    for camera in cameras:
        plain = scale = min(1.0, max_side / max(camera.width, camera.height))
        if framed:
            scale = max(scale, framing_scale(camera, model.ball, max_side))
        photo = load_photo(views, model, camera, scale=scale)
        rgb = _bytes(photo.rgb).transpose(2, 0, 1)
        mask = None if photo.mask is None else torch.from_numpy(_bytes(photo.mask))
        valid = None if photo.valid.all() else torch.from_numpy(photo.valid)
        pinhole = Pinhole.of(photo.camera, near)
        rgb_tensor = torch.from_numpy(np.ascontiguousarray(rgb))
        taken = TrainingPhoto(photo.camera, pinhole, rgb_tensor, mask, valid)
        if framed:
            part = cropped(taken, max_side)
            taken = part if part is not taken else shrunk(taken, plain / scale)
        photos.append(taken)
        frames.append(_frame(photo.camera, model.ball))
    if framed:  # one height for all: recorded steps of a size can be repeated
        photos = [replace(photo, frame=float(np.mean(frames))) for photo in photos]
    return photos


def _frame(camera: Camera, ball: Ball) -> float:
    """Height of a usual photo that shows the ball as large as this one, at most this one's."""
    longest = max(camera.width, camera.height)
    usual = _across(camera, ball) / FILL
    return camera.height * min(1.0, usual / longest)


def _across(camera: Camera, ball: Ball) -> float:
    """How wide the ball is in a photo, pixels."""
    distance = max(float(np.linalg.norm(camera.center - ball.center)), ball.radius)
    return 2 * float(camera.K[0, 0]) * ball.radius / distance


def framing_scale(camera: Camera, ball: Ball, max_side: int) -> float:
    """The scale, at most 1, at which the ball is as large as in a usual photo of `max_side`."""
    return min(1.0, FILL * max_side / max(_across(camera, ball), 1.0))


def most_pixels(camera: Camera, ball: Ball, max_side: int) -> float:
    """Pixels of a training photo at most, cut to the object or not."""
    pixels = camera.width * camera.height
    whole = pixels * min(1.0, max_side / max(camera.width, camera.height)) ** 2
    return max(whole, min(pixels * framing_scale(camera, ball, max_side) ** 2, max_side**2))


def cropped(photo: TrainingPhoto, max_side: int) -> TrainingPhoto:
    """The part of a photo that shows the object, by its mask, with a margin.

    Without a mask, or with an empty one, it is the same photo. The rest shows no object; training
    does not need it.

    Args:
        max_side: of whole photos, pixels; sides of parts are multiples of a quarter of it.
    """
    if photo.mask is None or not (photo.mask > 0).any():
        return photo
    spans = []
    for axis, whole in ((1, photo.camera.height), (0, photo.camera.width)):
        used = torch.nonzero((photo.mask > 0).any(axis)).ravel()
        first, last = int(used[0]), int(used[-1]) + 1
        step = max(16, max_side // STEPS)
        needed = (last - first) * (1 + 2 * MARGIN)
        side = min(whole, step * math.ceil(needed / step))
        start = min(max(0, (first + last - side) // 2), whole - side)
        spans.append(slice(start, start + side))
    rows, columns = spans
    camera = photo.camera.part(columns.start, columns.stop, rows.start, rows.stop)
    part = photo.each(lambda pixels: pixels[..., rows, columns].contiguous())
    return replace(part, camera=camera, pinhole=Pinhole.of(camera, photo.pinhole.near))


def shrunk(photo: TrainingPhoto, scale: float) -> TrainingPhoto:
    """The photo resampled to a smaller scale."""
    if scale >= 1:
        return photo
    width = max(16, round(photo.camera.width * scale))
    height = max(16, round(photo.camera.height * scale))
    on = _shrunk_there if photo.rgb.is_cuda else _shrunk_here
    frame = None if photo.frame is None else photo.frame * scale
    return replace(on(photo, width, height), frame=frame)


def _shrunk_here(photo: TrainingPhoto, width: int, height: int) -> TrainingPhoto:
    """`shrunk` by OpenCV."""
    import cv2

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
    valid, beyond = (_all_within(of, width, height) for of in (photo.valid, photo.beyond))
    camera = photo.camera.resized(width, height)
    pixels = np.ascontiguousarray(np.rint(rgb.clip(0, 255)).astype(np.uint8).transpose(2, 0, 1))
    pinhole = Pinhole.of(camera, photo.pinhole.near)
    rgb_tensor = torch.from_numpy(pixels)
    reduced = TrainingPhoto(camera, pinhole, rgb_tensor, small, valid)
    return replace(reduced, which=photo.which, beyond=beyond)


def _all_within(which: Tensor | None, width: int, height: int) -> Tensor | None:
    """(height, width) whether every pixel of (H, W) bool that goes into a new one is true."""
    import cv2

    if which is None:
        return None
    grown = cv2.resize(
        which.numpy().astype(np.float32), (width, height), interpolation=cv2.INTER_AREA
    )
    return torch.from_numpy(grown > 0.999)


def _shrunk_there(photo: TrainingPhoto, width: int, height: int) -> TrainingPhoto:
    """`shrunk` where the photo is, by the same means over areas, in float32."""

    def small(planes: Tensor) -> Tensor:
        rows = area_weights(planes.shape[-2], height).to(planes.device)
        columns = area_weights(planes.shape[-1], width).to(planes.device)
        return rows @ planes @ columns.T

    rgb, mask = photo.rgb.float(), photo.mask
    if mask is not None:
        whole = mask.float()
        rgb, whole = small(rgb * (whole / 255)), small(whole)
        rgb = torch.where(whole > 0.5, rgb / (whole / 255).clamp(min=1e-6), 0.0)
        mask = whole.round().to(torch.uint8)
    else:
        rgb = small(rgb)
    valid, beyond = (
        None if of is None else small(of.float()) > 0.999 for of in (photo.valid, photo.beyond)
    )
    camera = photo.camera.resized(width, height)
    pinhole = Pinhole.of(camera, photo.pinhole.near)
    pixels = rgb.clamp(0, 255).round().to(torch.uint8)
    reduced = TrainingPhoto(camera, pinhole, pixels, mask, valid)
    return replace(reduced, which=photo.which, beyond=beyond)


def numbered(photos: list[TrainingPhoto]) -> list[TrainingPhoto]:
    """The photos, each with its place among them."""
    places = torch.eye(len(photos))
    return [replace(photo, which=place) for photo, place in zip(photos, places, strict=True)]


def area_weights(large: int, small: int) -> Tensor:
    """(small, large) what share of each new pixel comes from each old one; rows sum to 1."""
    edges = torch.arange(small + 1, dtype=torch.float64) * (large / small)
    old = torch.arange(large, dtype=torch.float64)
    begin = torch.maximum(edges[:-1, None], old)
    end = torch.minimum(edges[1:, None], old + 1)
    return ((end - begin).clamp(min=0) * (small / large)).float()


def _bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(image.clip(0, 1) * 255), np.uint8)
