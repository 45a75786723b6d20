"""Short trainings that answer a question before the long one."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from refdgs_pipe.training.field import TrainableField
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.shading import draw
from refdgs_pipe.training.step import take_step

TOLD_STEPS = 10


def short_run(
    field: TrainableField,
    photos: list[TrainingPhoto],
    steps: int,
    seed: int,
    *,
    masked: bool,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Train a field in place, without checkpoints.

    Args:
        photos: where the field is.
        masked: the photos' background is removed: each step has another backdrop.
        progress: told the steps done and their number; may raise.
    """
    rng = torch.Generator().manual_seed(seed)
    black = torch.zeros(3, device=field.device)
    for step in range(steps):
        if progress is not None and step % TOLD_STEPS == 0:
            progress(step, steps)
        field.set_rates(step / steps)
        photo = photos[int(torch.randint(len(photos), (1,), generator=rng))]
        backdrop = torch.rand(3, generator=rng).to(field.device) if masked else black
        take_step(field, photo, backdrop, step / steps)
        if field.adapts(step + 1):
            field.adapt(step + 1, rng)


def explained(
    field: TrainableField,
    photos: Sequence[TrainingPhoto],
    where: Callable[[TrainingPhoto], NDArray[np.bool_]],
) -> float:
    """PSNR in dB, sRGB, of photos as a trained field on the CPU shows them over black.

    Args:
        where: the (H, W) pixels of a photo that count.
    """
    missed, count = 0.0, 0
    for photo in photos:
        with torch.no_grad():
            picture = draw(field.scene(photo.pinhole, 1.0), photo.pinhole, torch.zeros(3)).image
        there = torch.from_numpy(where(photo))
        wanted = photo.rgb.permute(1, 2, 0).float() / 255
        apart = (picture.clamp(0, 1) - wanted)[there].square().mean(-1)
        missed, count = missed + float(apart.sum()), count + int(there.sum())
    return -10 * float(np.log10(max(missed / max(count, 1), 1e-9)))
