"""A first look at photos without masks: where the object is, and what lies behind it.

Started throughout the ball, surfels that must make one sharp surface at once make it of the ball:
a crystal ball that shows the object as its reflection. A short run that asks for no sharp surface
finds the object instead; what it covers stands for masks when the start is looked for.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.training.field import TrainableField
from refdgs_pipe.training.photos import TrainingPhoto, shrunk
from refdgs_pipe.training.settings import StartParams, TrainParams
from refdgs_pipe.training.shading import draw
from refdgs_pipe.training.short_run import short_run
from refdgs_pipe.training.starting import Given, start_of

Progress = Callable[[int, int], None]
"""Told the steps done and their number; may raise."""

_LEAST = 0.002  # of the median photo, that an object covers
_REACH = 0.0075  # of the longer side: masks that were found are blurred by less
_FILE = "look.safetensors"
_GENTLE = {
    "normal_weight": 0.05,
    "normal_edge": 1000.0,
    "distortion_weight": 0.0,
    "specular_weight": 0.0,
    "turn_share": 0.0,
    "local_from": 0.1,
    "anneal_from": 1.0,
    "prune_opacity": 0.05,
    "split_size": 0.01,
    "rate_means": 1.6e-4,
    "rate_diffuse": 0.01,
    "rate_environment": 0.002,
    "rate_shader": 5e-4,
    "rate_features": 0.002,
}
"""What differs from the defaults. Reflections take part: without them mirrors are lost."""


@dataclass(frozen=True)
class Look:
    """What was found.

    Args:
        photos: those that were given, each with the object as its mask; without, if none was found.
        background: what lies behind the object, as `TrainableSet.raw` has it.
        covers: photo -> (h, w) uint8, how much of each pixel the object covers; empty if no object
            was found.
        random: state of torch's generator after the look.
    """

    photos: list[TrainingPhoto]
    background: dict[str, Tensor]
    covers: dict[str, np.ndarray]
    random: Tensor


def look(
    params: StartParams,
    model: SparseModel,
    photos: list[TrainingPhoto],
    scratch: Path,
    *,
    near: float,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Look:
    """Find the object in photos without masks; what was found stays in `scratch`.

    Args:
        photos: on the CPU, without masks.
        near: depth before which nothing is drawn, world units.
    """
    kept = scratch / _FILE
    if not kept.is_file():
        _keep(kept, params, model, photos, near=near, device=device, progress=progress)
    tensors = load_file(kept)
    random = tensors.pop("random")
    covers = {photo.camera.name: tensors.pop(f"mask {i}").numpy() for i, photo in enumerate(photos)}
    shown = float(np.median([(mask > 127).mean() for mask in covers.values()]))
    if shown < _LEAST:  # then nothing is known, and surfels start throughout the ball
        covers = {}
    return Look(covered(photos, covers), tensors, covers, random)


def covered(photos: list[TrainingPhoto], covers: Mapping[str, np.ndarray]) -> list[TrainingPhoto]:
    """The photos with what a look found as their masks, of any size; as they are without a look."""
    if not covers:
        return photos
    import cv2

    out = []
    for photo in photos:
        mask = covers.get(photo.camera.name)
        if mask is not None:
            size = (photo.camera.width, photo.camera.height)
            large = cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR)
            photo = replace(photo, mask=torch.from_numpy(np.ascontiguousarray(large)))
        out.append(photo)
    return out


def limited(photos: list[TrainingPhoto]) -> list[TrainingPhoto]:
    """Photos that `covered` gave masks, without those, but with what lies beyond the object."""
    return [
        replace(photo, mask=None, beyond=None if photo.mask is None else _beyond(photo.mask))
        for photo in photos
    ]


def _keep(
    path: Path,
    params: StartParams,
    model: SparseModel,
    photos: list[TrainingPhoto],
    *,
    near: float,
    device: str,
    progress: Progress | None,
) -> None:
    """Look, and write what was found."""
    small = [shrunk(photo, params.look_scale) for photo in photos]
    field, random = _looked(params, model, small, near, device, progress)
    assert field.background is not None
    tensors = {name: raw.detach().cpu() for name, raw in field.background.raw.items()}
    masks = [torch.from_numpy(_covered(field, photo.to(device))) for photo in small]
    tensors |= {f"mask {i}": mask for i, mask in enumerate(masks)}
    part = path.with_suffix(".part")
    save_file({**tensors, "random": random}, part)
    part.replace(path)


def _looked(
    params: StartParams,
    model: SparseModel,
    photos: list[TrainingPhoto],
    near: float,
    device: str,
    progress: Progress | None,
) -> tuple[TrainableField, Tensor]:
    """The field of a short run that asks for no sharp surface, and torch's generator after it."""
    steps = params.look_steps
    own = _GENTLE | {
        "iterations": steps,
        "environment_height": params.look_environment,
        "max_surfels": params.look_surfels,
        "surfels_per_pixel": params.look_surfels_per_pixel,
    }
    start = start_of(
        Given(params.model_copy(update={"masked": "ball"}), model, photos), masked=False
    )
    gentle = TrainParams.model_validate(own)
    field = TrainableField(gentle, model, start, photos, masked=False, near=near, device=device)
    photos = [photo.to(device) for photo in photos]
    short_run(field, photos, steps, params.seed, masked=False, progress=progress)
    return field, field.random


def _covered(field: TrainableField, photo: TrainingPhoto) -> np.ndarray:
    """(H, W) uint8 how much of each pixel the object covers."""
    with torch.no_grad():
        scene = field.scene(photo.pinhole, 1.0)
        picture = draw(scene, photo.pinhole, torch.zeros(3, device=photo.rgb.device))
    alpha = picture.object_alpha.clamp(0, 1).cpu().numpy()
    return np.asarray(np.rint(255 * alpha), np.uint8)


def _beyond(mask: Tensor) -> Tensor:
    """(H, W) bool where the mask covers nothing, not even near by."""
    import cv2

    reach = max(1, round(_REACH * max(mask.shape)))
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    near = cv2.dilate((mask.numpy() > 127).astype(np.uint8), kernel)
    return torch.from_numpy(near == 0)
