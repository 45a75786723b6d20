"""How well photos agree on what lies below a lid."""

import numpy as np
import pytest
from training.test_inside import FLOOR, INNER, TOP, closed, open_box, photos_of

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.errors import Cancelled
from refdgs_pipe.training.initial import Hull
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.seen_below import Below, seen_below
from refdgs_pipe.training.vessels import Mouth, Plateau, find_plateau

Case = tuple[list[TrainingPhoto], SparseModel, Hull, Mouth]


def shade(points: np.ndarray) -> np.ndarray:
    """Broad shading without any detail, (N, 3) linear."""
    return np.asarray(0.4 + 0.15 * np.sin(2.5 * points @ np.eye(3) + np.arange(3)))


def case(floor: float) -> Case:
    photos, model = photos_of(open_box(floor, shade))
    return photos, model, *closed(photos, model)


def plateau_of(case: Case) -> Plateau:
    _, model, hull, mouth = case
    found = find_plateau(hull, mouth.lid, model.up)
    assert found is not None
    return found


def judged(case: Case, grounded: np.ndarray | None = None) -> Below:
    photos, _, hull, mouth = case
    none = np.zeros_like(hull.cells)
    ground = none if grounded is None else grounded
    found = seen_below(photos, hull, hull, mouth, plateau_of(case), ground)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def box() -> Case:
    return case(FLOOR)


def test_shading_without_detail_tells_a_mouth_and_its_floor(box: Case) -> None:
    hull = box[2]
    found = judged(box)
    assert found.opens, found.words
    assert found.depth == pytest.approx((TOP - FLOOR) / hull.cell, abs=5)
    x, y, z = np.meshgrid(*hull.axes(), indexing="ij")
    side, margin = np.maximum(np.abs(x), np.abs(y)), 2 * hull.cell
    room = (side < INNER - 2 * margin) & (z > FLOOR + 3 * margin) & (z < TOP - margin)
    assert (hull.cells & room).sum() > 3000  # silhouettes close it
    assert (found.vessel.cells & room).sum() < 0.02 * room.sum()
    below = hull.cells & (z < FLOOR - 2 * margin)
    assert (found.vessel.cells & below).sum() == below.sum()


def test_a_shaded_top_is_no_mouth() -> None:
    found = judged(case(TOP))
    assert not found.opens, found.words
    assert found.ratio > 1


def test_no_hollow_reaches_the_ground(box: Case) -> None:
    hull = box[2]
    z = np.meshgrid(*hull.axes(), indexing="ij")[2]
    found = judged(box, z < 0.3)
    assert (found.vessel.cells & (z < 0.3)).sum() == (hull.cells & (z < 0.3)).sum()


def test_too_few_photos_from_above_tell_nothing(box: Case) -> None:
    photos, _, hull, mouth = box
    none = np.zeros_like(hull.cells)
    assert seen_below(photos[:8], hull, hull, mouth, plateau_of(box), none) is None
    assert seen_below(photos[:15], hull, hull, mouth, plateau_of(box), none) is None


def test_a_stop_is_heard(box: Case) -> None:
    photos, _, hull, mouth = box

    def stop(done: int, total: int) -> None:
        raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        seen_below(photos, hull, hull, mouth, plateau_of(box), np.zeros_like(hull.cells), stop)
