"""Level tops of hulls, tried as the mouths of vessels."""

from pathlib import Path

import numpy as np
import pytest
from training.test_trainer import SMALL, capture

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.training import vessels
from refdgs_pipe.training.initial import Hull, object_hull
from refdgs_pipe.training.photos import load_training_photos
from refdgs_pipe.training.step import near_of
from refdgs_pipe.training.vessels import Mouth, Trial, find_mouth, tried

UP = np.array([0.0, 0.0, 1.0])
TICKS = np.linspace(-1, 1, 48)
X, Y, Z = np.meshgrid(TICKS, TICKS, TICKS, indexing="ij")
RADIUS = np.hypot(X, Y)


def hull(cells: np.ndarray) -> Hull:
    return Hull(cells, TICKS, Ball(np.zeros(3), 1.0))


def closed_bowl() -> np.ndarray:
    """A cone that widens upwards, closed at its mouth as silhouettes close it."""
    return np.asarray((Z > -0.5) & (Z < 0.4) & (RADIUS < 0.3 + 0.6 * (Z + 0.5)))


def test_a_level_top_is_opened_as_a_vessel_with_even_walls() -> None:
    mouth = find_mouth(hull(closed_bowl()), UP)
    assert mouth is not None
    gone = closed_bowl() & ~mouth.vessel.cells
    assert not (mouth.vessel.cells & ~closed_bowl()).any()
    assert gone.sum() > 0.5 * closed_bowl().sum()
    cell = TICKS[1] - TICKS[0]
    wall = 0.3 + 0.6 * (Z + 0.5) - RADIUS  # how far inside of the outer wall
    assert wall[gone].min() > 0.8 * cell
    assert (Z[gone] + 0.5).min() > 1.5 * cell  # the floor stays
    axis = mouth.vessel.cells[24, 24]
    assert not axis[TICKS > -0.3].any() and axis[TICKS < -0.45].any()


def test_what_photos_agreed_on_already_is_not_tried_again() -> None:
    mouth = find_mouth(hull(closed_bowl()), UP)
    assert mouth is not None
    dented = hull(closed_bowl() & (Z < 0.35))
    again = mouth.within(dented)
    assert again is not None and not (again.vessel.cells & ~dented.cells).any()
    assert mouth.within(mouth.vessel) is None


def test_a_domed_top_is_no_lid() -> None:
    dome = np.asarray((Z > -0.5) & (RADIUS**2 + (Z + 0.5) ** 2 < 0.8))
    assert find_mouth(hull(dome), UP) is None


def test_a_small_level_top_is_no_lid() -> None:
    cone = np.asarray((Z > -0.5) & (Z < 0.4) & (RADIUS < 0.75 - 0.65 * (Z + 0.5)))
    assert find_mouth(hull(cone), UP) is None


def test_a_thin_plate_has_no_hollow() -> None:
    plate = np.asarray((np.abs(Z) < 0.03) & (RADIUS < 0.8))
    assert find_mouth(hull(plate), UP) is None


def test_a_vessel_has_to_explain_clearly_more() -> None:
    assert Trial(20.0, 21.0).opens
    assert not Trial(20.0, 20.3).opens
    assert not Trial(21.0, 20.0).opens


def test_both_answers_are_judged_by_photos_that_were_held_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, model = capture(tmp_path, size=32, masked=True)
    near = near_of(model)
    photos = load_training_photos(views, model, max_side=32, near=near)
    found = object_hull(SMALL.start, model, photos)
    assert found is not None
    lid = found.ball.center + 0.3 * found.ball.radius * UP[None]
    for name, value in {"STEPS": 4, "SURFELS": 50, "FEWEST": 1, "LOOKS_IN": -1.0}.items():
        monkeypatch.setattr(vessels, name, value)
    told: list[tuple[int, int]] = []
    mouth = Mouth(lid, found.cells, found)

    def progress(done: int, total: int) -> None:
        told.append((done, total))

    trial = tried(SMALL.start, model, photos, found, mouth, near=near, progress=progress)
    assert trial is not None
    assert trial.closed == trial.vessel  # of one solid twice
    assert told == [(0, 8), (4, 8)]
    monkeypatch.setattr(vessels, "FEWEST", len(photos) + 1)
    assert tried(SMALL.start, model, photos, found, mouth, near=near) is None
