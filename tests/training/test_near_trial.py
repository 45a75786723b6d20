"""Whether near-field features stay: decided by photos that short trainings have not seen."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_erosion
from training.test_trainer import SMALL, capture

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.training import near_trial as module
from refdgs_pipe.training.begin import begin
from refdgs_pipe.training.field import TrainableField
from refdgs_pipe.training.near_trial import EACH, is_due, settled
from refdgs_pipe.training.photos import TrainingPhoto, load_training_photos
from refdgs_pipe.training.short_run import explained, short_run

pytestmark = pytest.mark.usefixtures("coarse_start")
PARAMS = SMALL.train.model_copy(update={"local_trial_steps": 4})


@pytest.fixture
def given(tmp_path: Path) -> tuple[Views, SparseModel, Start]:
    views, model = capture(tmp_path / "views", size=32)
    return views, model, begin(views, model, SMALL.start, tmp_path).start


def test_both_arms_learn_the_same_photos_and_are_asked_for_the_others(
    given: tuple[Views, SparseModel, Start], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learnt, asked, told = list[list[str]](), list[list[str]](), list[tuple[int, int]]()

    def noted_run(field: TrainableField, photos: list[TrainingPhoto], *a: Any, **k: Any) -> None:
        learnt.append([photo.camera.name for photo in photos])
        assert (field.local is None) == (len(learnt) == 2)
        short_run(field, photos, *a, **k)

    def noted_figure(field: TrainableField, photos: list[TrainingPhoto], where: Any) -> float:
        asked.append([photo.camera.name for photo in photos])
        return explained(field, photos, where)

    monkeypatch.setattr(module, "short_run", noted_run)
    monkeypatch.setattr(module, "explained", noted_figure)
    _, found = settled(
        PARAMS, *given, tmp_path, progress=lambda step, steps: told.append((step, steps))
    )
    names = {camera.name for camera in given[1].cameras}
    assert learnt[0] == learnt[1] and asked[0] == asked[1]
    assert not set(learnt[0]) & set(asked[0]) and {*learnt[0], *asked[0]} == names
    assert len(asked[0]) == pytest.approx(len(names) / EACH, abs=1)
    assert told == [(0, 8), (4, 8)]
    assert found is not None and np.isfinite([found.near, found.far]).all()


@pytest.mark.parametrize(("gain", "kept"), [(0.1, "dual"), (-0.1, "none")])
def test_near_field_features_stay_only_if_they_help(
    given: tuple[Views, SparseModel, Start],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    gain: float,
    kept: str,
) -> None:
    figures = iter([30.0 + gain, 30.0])
    monkeypatch.setattr(module, "explained", lambda *_: next(figures))
    params, found = settled(PARAMS, *given, tmp_path)
    assert params.local == kept
    assert params == PARAMS.model_copy(update={"local": kept})
    assert found is not None and found.words == f"{30 + gain:.2f} dB with them, 30.00 dB without"


def test_a_training_that_goes_on_does_not_try_again(
    given: tuple[Views, SparseModel, Start], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, first = settled(PARAMS, *given, tmp_path)
    monkeypatch.setattr(module, "short_run", lambda *_, **__: pytest.fail("it trained again"))
    assert settled(PARAMS, *given, tmp_path)[1] == first


def test_a_damaged_answer_is_found_again(
    given: tuple[Views, SparseModel, Start], tmp_path: Path
) -> None:
    _, first = settled(PARAMS, *given, tmp_path)
    for text in ("", "[]", '{"near": 1}', '{"near": "a", "far": 2}'):
        (tmp_path / module.RESULT).write_text(text, "utf-8")
        assert settled(PARAMS, *given, tmp_path)[1] == first


def test_too_few_photos_for_a_trial_are_too_few_for_near_field_features(
    given: tuple[Views, SparseModel, Start], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FEWEST", 13)
    params, found = settled(PARAMS, *given, tmp_path)
    assert found is None and params.local == "none"


@pytest.mark.parametrize(
    "change",
    [
        {"reflection": False},
        {"local": "none"},
        {"local": "shared"},
        {"local_trial_steps": 0},
        {"iterations": 3},
    ],
)
def test_there_is_no_trial_without_a_question(change: dict[str, Any]) -> None:
    assert is_due(PARAMS)
    assert not is_due(PARAMS.model_copy(update=change))


def test_a_stain_in_the_photo_lowers_the_figure(
    given: tuple[Views, SparseModel, Start], tmp_path: Path
) -> None:
    """What is compared is the object in held-out photos; the edge of its mask does not count."""
    views, model, start = given
    photos = load_training_photos(views, model, max_side=32, near=0.1)
    field = TrainableField(PARAMS, model, start, photos, masked=True, near=0.1)
    assert photos[0].mask is not None
    inside = binary_erosion(photos[0].mask.numpy() > 127, iterations=module.INSIDE)
    clean = explained(field, photos[:1], module._inside)
    before = photos[0].rgb.clone()
    photos[0].rgb[:, ~inside] = 255
    assert explained(field, photos[:1], module._inside) == clean
    photos[0].rgb.copy_(before)
    row, column = np.argwhere(inside)[len(np.argwhere(inside)) // 2]
    photos[0].rgb[:, row, column] = 255
    assert explained(field, photos[:1], module._inside) < clean
