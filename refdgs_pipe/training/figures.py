"""What is told of a training: while it runs, and when a part of it is through."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from refdgs_pipe.artifacts.surfel_field import SurfelField


@dataclass(frozen=True)
class Figures:
    """How a run goes: running means of the loss and of the PSNR in dB, and geometry surfels."""

    loss: float
    psnr: float
    surfels: int

    @property
    def words(self) -> str:
        """For people."""
        return f"loss {self.loss:.4f}  PSNR {self.psnr:.2f} dB  {self.surfels} surfels"


Progress = Callable[[int, int, Figures, float], None]
"""Told the step, the steps, how it goes, and the share of the work that is done; may raise."""


def teller(sample: Callable[..., None], progress: Callable[..., None]) -> Progress:
    """Tells figures as data and in words, as a `Job` takes them."""

    def tell(step: int, steps: int, now: Figures, work: float) -> None:
        sample(step, steps, loss=now.loss, psnr=now.psnr, surfels=now.surfels)
        progress("training", step, steps, now.words, work)

    return tell


def told_figures(
    figures: Mapping[str, Any], field: SurfelField
) -> list[tuple[str, float | int | str, str]]:
    """What to tell of a part of a run that is through: name, value, unit.

    Args:
        figures: of `Trainer.figures`.
    """
    loss, fit, early = figures["loss"], figures["psnr"], figures["early"]
    means = [("loss", round(loss, 5), ""), ("train PSNR", round(fit, 2), "dB")]
    return [
        ("steps", figures["iteration"], ""),
        *([("stopped early", early, "")] if early else []),
        *(means if math.isfinite(loss) else []),
        ("surfels", len(field.geometry), ""),
        ("local surfels", len(field.local), ""),
        ("background surfels", len(field.background), ""),
    ]
