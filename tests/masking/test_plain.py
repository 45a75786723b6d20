"""A plain body that stands on a plane is told from what lies flat there, and from what hangs."""

import numpy as np
import pytest

from refdgs_pipe.camera import F64
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32, Bools
from refdgs_pipe.masking.plain import plain_feet

N, REACH = 256, 2.2
GROUND = Ground(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), REACH)
TABLE, BLACK, WHITE = -0.7, -3.0, -0.1
Box = tuple[tuple[float, float, float], tuple[float, float, float], float]
BODY: Box = ((-0.4, -0.3, 0.0), (0.4, 0.3, 0.25), BLACK)
FLAT: Box = ((-0.4, -0.3, 0.0), (0.4, 0.3, 0.0), BLACK)


def cameras() -> F64:
    """(16, 3) round the middle, at two heights."""
    turn = np.arange(16) / 16 * 2 * np.pi
    height = np.deg2rad(np.where(np.arange(16) % 2, 20, 50))
    out = np.stack([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)])
    return np.asarray(3 * out.T)


def shown(boxes: list[Box]) -> F32:
    """(16, N, N, 3) a spotted plane and boxes (low, high, log colour), as each camera sees them."""
    rng = np.random.default_rng(0)
    spots = rng.normal(TABLE, 0.4, (N // 8, N // 8, 1)).repeat(8, 0).repeat(8, 1)
    place = ((np.arange(N) + 0.5) / N * 2 - 1) * REACH
    x, y = np.meshgrid(place, place)
    ends = np.stack([x, y, np.zeros_like(x)], -1)
    out = np.empty((16, N, N, 3), np.float32)
    for photo, eye in zip(out, cameras(), strict=True):
        photo[:] = spots
        nearest = np.full((N, N), 1.0 + 1e-6)
        for low, high, colour in boxes:
            with np.errstate(divide="ignore"):
                one, other = ((np.array(side) - eye) / (ends - eye) for side in (low, high))
            enters, leaves = np.minimum(one, other).max(-1), np.maximum(one, other).min(-1)
            hit = (enters <= leaves + 1e-9) & (enters < nearest)
            photo[hit], nearest[hit] = colour, enters[hit]
        photo += rng.normal(0, 0.02, photo.shape)
    return out


def feet(boxes: list[Box]) -> Bools:
    """(N, N) what is found for the boxes; photos agree on their median."""
    seen = shown(boxes)
    return plain_feet(np.median(seen, axis=0), seen, GROUND, cameras(), 1.0)


def test_a_plain_plinth_below_a_bright_post_is_found_where_it_stands() -> None:
    post: Box = ((-0.1, -0.1, 0.25), (0.1, 0.1, 0.9), WHITE)
    found = feet([BODY, post])
    place = ((np.arange(N) + 0.5) / N * 2 - 1) * REACH
    x, y = np.meshgrid(place, place)
    true = (np.abs(x) < 0.4) & (np.abs(y) < 0.3)
    assert (found & true).sum() / (found | true).sum() > 0.85


@pytest.mark.parametrize(
    "boxes",
    [[FLAT], [((-0.5, -0.3, 0.08), (0.5, 0.3, 0.35), BLACK)], []],
    ids=["paper", "a body that hangs", "nothing"],
)
def test_what_does_not_stand_is_left_alone(boxes: list[Box]) -> None:
    assert not feet(boxes).any()


def test_paper_below_a_standing_body_is_not_taken_for_its_foot() -> None:
    found = feet([FLAT, ((-0.3, -0.22, 0.0), (0.3, 0.22, 0.5), WHITE)])
    rim = round((1 - 0.35 / REACH) * N / 2)  # column where the paper shows beside the body
    assert not found[:, :rim].any()
