"""Small things beside the object are left out; sets, feet and what is near stay."""

import numpy as np
import pytest

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.masking.beside import without_bystanders
from refdgs_pipe.masking.solid import Cells, grid

UP = np.array([0.0, 0.0, 1.0])
MIDDLE = np.array([0.0, 0.0, 0.3])


def cells() -> Cells:
    return grid(Ball(MIDDLE, 1.0), UP, 0.0, 64)


def block(space: Cells, x: float, y: float, low: float, *half: float) -> np.ndarray:
    away = np.abs(space.points - [x, y, low + half[2]])
    return np.asarray(space.inside & (away < half).all(1))


def left(*pieces: tuple[float, ...]) -> tuple[list[bool], int]:
    """Which pieces (x, y, low, half sizes) stay, and how many were left out."""
    space = cells()
    parts = [block(space, *piece) for piece in pieces]
    out, count = without_bystanders(space, np.any(parts, axis=0), (UP, 0.0), MIDDLE)
    assert not (out & ~np.any(parts, axis=0)).any()
    return [bool(out[part].mean() > 0.5) for part in parts], count


BODY = (0.0, 0.0, 0.0, 0.4, 0.25, 0.3)


def test_a_small_thing_beside_the_object_is_left_out() -> None:
    assert left(BODY, (0.75, 0.3, 0.0, 0.1, 0.1, 0.1)) == ([True, False], 1)


@pytest.mark.parametrize(
    "piece",
    [
        (0.1, 0.4, 0.0, 0.08, 0.08, 0.1),  # within the circle that the object fills
        (0.75, 0.0, 0.0, 0.2, 0.25, 0.3),  # a second one of like size: a set
        (0.75, 0.3, 0.4, 0.1, 0.1, 0.1),  # a part of it that hangs in the air
    ],
)
def test_what_may_belong_to_it_stays(piece: tuple[float, ...]) -> None:
    assert left(BODY, piece) == ([True, True], 0)


def test_below_an_object_that_hangs_nothing_is_left_out() -> None:
    hanging = (0.0, 0.0, 0.3, 0.4, 0.25, 0.2)
    assert left(hanging, (0.75, 0.3, 0.0, 0.1, 0.1, 0.1)) == ([True, True], 0)


def test_crumbs_beside_it_go_and_are_no_things() -> None:
    assert left(BODY, (0.75, 0.3, 0.0, 0.03, 0.03, 0.03)) == ([True, False], 0)
    assert left(BODY) == ([True], 0)
