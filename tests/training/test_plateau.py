"""Stopping early: what is held out, when it stops, and that an interruption changes nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from training.test_trainer import SMALL, capture, quiet
from training_runs import trainer_of

from refdgs_pipe.errors import Cancelled
from refdgs_pipe.training.photos import TrainingPhoto, load_training_photos, shrunk
from refdgs_pipe.training.plateau import Plateau, hold_out

pytestmark = pytest.mark.usefixtures("coarse_start")

# no gain is ever large enough, so that the first look after the wait ends it
HOPELESS = SMALL.but(
    iterations=120,
    coarse_until=0.1,
    reflect_from=0.0,
    local_from=0.1,
    patience=0.1,
    patience_tolerance=10.0,
)


def photos_of(folder: Path) -> list[TrainingPhoto]:
    views, model = capture(folder, size=128)
    return load_training_photos(views, model, max_side=128, near=0.01)


def test_held_out_pixels_are_on_the_object_and_never_count(tmp_path: Path) -> None:
    photos = photos_of(tmp_path / "views")
    held = hold_out(photos, 7)
    for before, after in zip(photos, held, strict=True):
        assert after.held is not None and after.valid is not None and before.mask is not None
        rows, columns = after.held
        assert len(rows) and bool((before.mask[rows, columns] > 127).all())
        for dy in (-5, 0, 5):  # nor does any pixel count whose SSIM window reaches them
            for dx in (-5, 0, 5):
                assert not bool(after.valid[rows + dy, columns + dx].any())
        assert 0 < int((~after.valid).sum()) < 0.2 * after.valid.numel()
        small = shrunk(after, 0.5)
        assert small.valid is not None
        assert not bool(small.valid[rows // 2, columns // 2].any())
    again = hold_out(photos, 7)
    assert all(torch.equal(a.held, b.held) for a, b in zip(held, again, strict=True))
    assert any(
        not torch.equal(a.held, b.held) for a, b in zip(held, hold_out(photos, 8), strict=True)
    )


def test_a_photo_without_room_holds_nothing_out(tmp_path: Path) -> None:
    photo = photos_of(tmp_path / "views")[0]
    empty = replace(photo, mask=torch.zeros_like(photo.mask))
    assert hold_out([empty], 0)[0].held is None


def test_a_plateau_is_no_gain_above_the_tolerance_for_long_enough(tmp_path: Path) -> None:
    photos = hold_out(photos_of(tmp_path / "views")[:2], 0)
    params = HOPELESS.but(patience=0.1, patience_tolerance=0.5, anneal_from=0.9, coarse=1.0)
    watch = Plateau(params.train, photos, reflect_from=0.2)
    first, second = (photo.camera.name for photo in photos)

    def both(error: float, fraction: float) -> bool:
        watch.note(first, error, fraction)
        watch.note(second, error, fraction)
        return watch.reached(fraction)

    assert not both(0.1, 0.15)  # some parts are still to come
    watch.note(first, 0.1, 0.2)
    assert not watch.reached(0.45)  # the other photo was not seen yet
    assert not both(0.1, 0.45)
    assert not both(0.08, 0.54)  # 1 dB better
    assert not both(0.0799, 0.63)
    assert both(0.0798, 0.65)
    assert not both(0.0798, 0.95)  # rates shrink by now


def test_a_run_that_gains_nothing_goes_on_at_its_annealing(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    told: list[tuple[int, int, float]] = []
    trainer = trainer_of(views, model, HOPELESS, tmp_path)
    trainer.run(lambda done, total, now, work: told.append((done, total, work)))
    assert 0 < trainer.skipped < 0.5 * HOPELESS.train.iterations
    assert trainer.iteration == HOPELESS.train.iterations - trainer.skipped
    assert told[-1] == (trainer.iteration, trainer.iteration, pytest.approx(1))
    shares = [work for _, _, work in told]
    assert shares == sorted(shares)
    tail = HOPELESS.train.iterations - round(HOPELESS.train.anneal_from * HOPELESS.train.iterations)
    assert sum(total < HOPELESS.train.iterations for _, total, _ in told) >= tail // 10
    rates = {g["name"]: g["lr"] for g in trainer.field.geometry.optimizer.param_groups}
    assert (
        rates["raw_opacities"] < 0.06 * HOPELESS.train.rate_opacities
    )  # it was annealed to the end
    assert trainer.early is not None and f"{trainer.skipped} of 120 steps left out" in trainer.early


def test_without_patience_nothing_is_held_out(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "views")
    params = HOPELESS.but(patience=0.0, iterations=20)
    trainer = trainer_of(views, model, params, tmp_path)
    assert all(photo.held is None and photo.valid is None for photo in trainer.full)
    trainer.run(quiet)
    assert trainer.iteration == 20 and trainer.early is None


@pytest.mark.parametrize("stop", [30, 60])
def test_an_interruption_before_or_after_the_jump_changes_nothing(
    tmp_path: Path, stop: int
) -> None:
    views, model = capture(tmp_path / "views")
    for name in "ab":
        (tmp_path / name).mkdir()
    whole = trainer_of(views, model, HOPELESS, tmp_path / "a")
    expected = whole.run(quiet)

    def interrupt(done: int, total: int, now: object, work: float) -> None:
        if done == stop:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        trainer_of(views, model, HOPELESS, tmp_path / "b").run(interrupt)
    resumed = trainer_of(views, model, HOPELESS, tmp_path / "b")
    found = resumed.run(quiet)
    assert (resumed.skipped, resumed.early) == (whole.skipped, whole.early)
    for name in ("means", "quats", "scales", "opacities"):
        np.testing.assert_array_equal(
            getattr(expected.geometry, name), getattr(found.geometry, name)
        )
