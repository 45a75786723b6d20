"""Stopping early: pixels that training never sees, and whether they still get better."""

import math
from dataclasses import replace

import torch

from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.settings import TrainParams

PATCH = 16  # pixels along the edge of what is held out
REACH = 5  # of the window of SSIM, through which a counted pixel feels its neighbours
SHARE = 0.02  # of the object's pixels
MOST_PHOTOS = 24


def hold_out(photos: list[TrainingPhoto], seed: int) -> list[TrainingPhoto]:
    """Some patches of up to 24 photos, the same for the same seed, taken out of the image loss.

    Whole patches become invalid. Only their middles, on the object, are measured: they lie in no
    SSIM window of a pixel that counts. Masks keep their say there.
    """
    every = math.ceil(len(photos) / MOST_PHOTOS)
    return [_held(photo, seed + i) if i % every == 0 else photo for i, photo in enumerate(photos)]


def _held(photo: TrainingPhoto, seed: int) -> TrainingPhoto:
    height, width = photo.rgb.shape[1:]
    usable = torch.ones(height, width, dtype=torch.bool)
    if photo.valid is not None:
        usable &= photo.valid
    if photo.mask is not None:
        usable &= photo.mask > 127
    down, across = height // PATCH, width // PATCH
    cells = usable[: down * PATCH, : across * PATCH].reshape(down, PATCH, across, PATCH)
    middle = slice(REACH, PATCH - REACH)
    whole = torch.nonzero(cells[:, middle, :, middle].all(3).all(1))
    if not len(whole):
        return photo
    rng = torch.Generator().manual_seed(seed)
    count = max(1, round(SHARE * len(whole)))
    corners = PATCH * whole[torch.randperm(len(whole), generator=rng)[:count]]

    def pixels(border: int) -> tuple[torch.Tensor, torch.Tensor]:
        steps = torch.arange(border, PATCH - border)
        rows, columns = torch.meshgrid(steps, steps, indexing="ij")
        inside = torch.stack([rows, columns], -1).reshape(-1, 2)
        rows, columns = (corners[:, None] + inside).reshape(-1, 2).unbind(-1)
        return rows, columns

    valid = torch.ones_like(usable) if photo.valid is None else photo.valid.clone()
    valid[pixels(0)] = False
    return replace(photo, valid=valid, held=torch.stack(pixels(REACH)))


class Plateau:
    """When the mean error of held-out pixels has stopped falling.

    It watches at full size, once every part of the field takes part, until rates shrink.
    """

    def __init__(
        self, params: TrainParams, photos: list[TrainingPhoto], reflect_from: float
    ) -> None:
        begins = [params.coarse_until if params.coarse < 1 else 0.0]
        if params.reflection:
            begins += [reflect_from, params.local_from if params.local == "dual" else 0.0]
        self.begin, self.end = max(begins), params.anneal_from
        self.patience, self.tolerance = params.patience, params.patience_tolerance
        self.errors = {photo.camera.name: math.nan for photo in photos if photo.held is not None}
        self.best, self.best_at = -math.inf, 0.0  # dB, and the fraction of the run

    def note(self, name: str, error: float, fraction: float) -> None:
        """Take a photo's mean squared error on its held-out pixels."""
        if self.begin <= fraction < self.end:
            self.errors[name] = error

    def reached(self, fraction: float) -> bool:
        """Whether there was no gain for too long; asks for every photo's error first."""
        known = [error for error in self.errors.values() if math.isfinite(error)]
        if not known or len(known) < len(self.errors) or not self.begin <= fraction < self.end:
            return False
        figure = -10 * math.log10(max(sum(known) / len(known), 1e-10))
        if figure > self.best + self.tolerance:
            self.best, self.best_at = figure, fraction
        return fraction - self.best_at >= self.patience

    def state(self) -> dict[str, object]:
        """What goes on after an interruption."""
        return {"errors": self.errors, "best": self.best, "best_at": self.best_at}

    def restore(self, state: dict[str, object]) -> None:
        """Inverse of `state`."""
        vars(self).update(state)
