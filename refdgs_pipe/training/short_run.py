"""Short trainings that answer a question before the long one."""

from collections.abc import Callable

import torch

from refdgs_pipe.training.field import TrainableField
from refdgs_pipe.training.photos import TrainingPhoto
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
