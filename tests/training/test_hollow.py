"""The inside of a vessel stays empty while discs are trained."""

from dataclasses import replace
from pathlib import Path

import finished
import numpy as np
import pytest
import torch
from training.test_trainer import SMALL, capture

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.start import HOLLOW, SOLID, Start
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.training.field import TrainableField
from refdgs_pipe.training.hollow import Hollow
from refdgs_pipe.training.initial import hull_ticks, object_hull
from refdgs_pipe.training.photos import load_training_photos
from refdgs_pipe.training.starting import Given, start_of
from refdgs_pipe.training.step import near_of

N = 32
BALL = Ball(np.array([0.5, 0.0, -0.2]), 2.0)
TICKS = hull_ticks(BALL, N)
CELL = float(TICKS[1] - TICKS[0])


def box() -> np.ndarray:
    """A box that is open above: its floor is layer 8, its walls are columns 8 and 23."""
    cells = np.zeros((N, N, N), np.uint8)
    cells[8:24, 8:24, 8:20] = SOLID
    cells[9:23, 9:23, 9:20] = HOLLOW
    return cells


def at(i: float, j: float, k: float) -> torch.Tensor:
    """The centre of a cell, world."""
    point = BALL.center + TICKS[0] + CELL * np.array([i, j, k])
    return torch.from_numpy(point.astype(np.float32))


def test_what_floats_in_a_hollow_moves_back_to_the_nearest_wall() -> None:
    hollow = Hollow(box(), BALL)
    floating, kept = torch.stack([at(16, 16, 14), at(9, 16, 15)]), at(8, 16, 15)[None]
    moved = hollow.kept_empty(floating)
    torch.testing.assert_close(moved, torch.stack([at(16, 16, 8), at(8, 16, 15)]))
    torch.testing.assert_close(hollow.kept_empty(moved), moved)
    torch.testing.assert_close(hollow.kept_empty(kept), kept)


def test_discs_outside_the_hollow_stay_where_they_are() -> None:
    hollow = Hollow(box(), BALL)
    others = torch.stack([at(16, 16, 8), at(16, 16, 22), at(2, 2, 2), at(-40, 16, 90)])
    assert torch.equal(hollow.kept_empty(others), others)


def test_a_start_keeps_its_vessel(tmp_path: Path) -> None:
    start = replace(finished.start(), vessel=box())
    start.save(tmp_path)
    found = Start.load(tmp_path)
    assert found.vessel is not None
    np.testing.assert_array_equal(found.vessel, box())


def test_a_damaged_vessel_is_refused(tmp_path: Path) -> None:
    replace(finished.start(), vessel=box()[:5]).save(tmp_path)
    with pytest.raises(CorruptError, match="no cube"):
        Start.load(tmp_path)


def test_training_keeps_the_hollow_of_its_start_empty(tmp_path: Path) -> None:
    views, model = capture(tmp_path, size=32, masked=True)
    photos = load_training_photos(views, model, max_side=32, near=near_of(model))
    hull = object_hull(SMALL.start, model, photos)
    assert hull is not None
    center = np.argwhere(hull.cells).mean(0).round().astype(int)
    hollow = np.zeros_like(hull.cells)
    hollow[tuple(slice(c - 4, c + 5) for c in center)] = True
    opened = replace(hull, cells=hull.cells & ~hollow)
    start = start_of(Given(SMALL.start, model, photos, hull=opened, hollow=hollow), masked=True)
    assert start.vessel is not None
    np.testing.assert_array_equal(start.vessel == HOLLOW, hollow)
    np.testing.assert_array_equal(start.vessel == SOLID, opened.cells)
    train = SMALL.train
    field = TrainableField(train, model, start, photos, masked=True, near=near_of(model))
    middle = torch.from_numpy(hull.ball.center + hull.ticks[center]).float()
    with torch.no_grad():
        field.geometry.raw["means"][0] = middle
    iteration = train.densify_every
    assert field.adapts(iteration)
    field.adapt(iteration, torch.Generator().manual_seed(0))
    away = (field.geometry.raw["means"].detach() - middle).norm(dim=1)
    assert float(away.min()) > 2 * hull.cell
