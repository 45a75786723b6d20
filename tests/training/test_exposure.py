"""Photos that were not exposed alike."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from training.test_trainer import SMALL, capture, quiet
from training_runs import trainer_of

from refdgs_pipe.errors import Cancelled
from refdgs_pipe.training.photos import TrainingPhoto, load_training_photos, shrunk

pytestmark = pytest.mark.usefixtures("coarse_start")

FITTED = SMALL.but(
    exposure="fitted",
    rate_exposure=0.02,
    look_steps=0,
    iterations=150,
    surfels=400,
    background_surfels=6000,
)
DARK = (2, 5, 9)


def some_darker(photos: list[TrainingPhoto]) -> list[TrainingPhoto]:
    return [
        replace(p, rgb=(p.rgb.float() * 0.75).to(torch.uint8)) if i in DARK else p
        for i, p in enumerate(photos)
    ]


def factors(folder: Path, weight: float) -> np.ndarray:
    views, model = capture(folder / "views", masked=False, size=32)
    photos = some_darker(load_training_photos(views, model, max_side=32, near=0.02))
    params = FITTED.but(exposure_weight=weight)
    (folder / "run").mkdir()
    trainer = trainer_of(views, model, params, folder / "run", photos=photos)
    trainer.run(quiet)
    assert trainer.field.exposures is not None
    return np.exp(trainer.field.exposures.logs.detach().numpy())


def test_darker_photos_get_smaller_factors(tmp_path: Path) -> None:
    found = factors(tmp_path, 0.05)
    others = np.delete(found, DARK)
    assert np.ptp(others) < 0.15
    assert 0.6 < found[list(DARK)].mean() / others.mean() < 0.9  # the truth is 0.75


def test_a_large_weight_holds_the_factors_at_one(tmp_path: Path) -> None:
    assert np.abs(factors(tmp_path, 10.0) - 1).mean() < 0.03  # 0.1 at the usual weight


def test_factors_survive_an_interruption(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views", masked=False, size=32)
    params = FITTED.but(iterations=20)
    for name in "ab":
        (tmp_path / name).mkdir()

    def stop(done: int, total: int, now: object, work: float) -> None:
        if done == 10:
            raise Cancelled("enough")

    trainers = [trainer_of(views, model, params, tmp_path / name) for name in "ab"]
    trainers[0].run(quiet)
    try:
        trainers[1].run(stop)
    except Cancelled:
        trainers[1] = trainer_of(views, model, params, tmp_path / "b")
        trainers[1].run(quiet)
    whole, resumed = (t.field.exposures for t in trainers)
    assert whole is not None and resumed is not None and whole.logs.abs().max() > 0
    assert torch.equal(whole.logs, resumed.logs)


def test_a_photo_keeps_its_place_when_it_shrinks_and_with_masks_there_are_no_factors(
    tmp_path: Path,
) -> None:
    views, model = capture(tmp_path / "views", size=32)
    trainer = trainer_of(views, model, FITTED, tmp_path)
    assert trainer.field.exposures is None
    photo = replace(trainer.full[0], which=torch.tensor([0.0, 1.0]))
    assert shrunk(photo, 0.5).which is photo.which
