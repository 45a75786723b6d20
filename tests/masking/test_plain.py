"""A plain body that stands on a plane is told from what lies flat there, and from what hangs."""

import numpy as np
import pytest
from boxes import BLACK, BODY, FLAT, GROUND, REACH, TABLE, WHITE, Box, N, cameras, shown

from refdgs_pipe.ground.shots import Bools
from refdgs_pipe.masking.plain import plain_bodies

HANGING: Box = ((-0.5, -0.3, 0.08), (0.5, 0.3, 0.35), BLACK)


def bodies(boxes: list[Box]) -> tuple[Bools, Bools]:
    """(N, N) what is found for the boxes, standing and hanging; photos agree on their median."""
    seen = shown(boxes)
    return plain_bodies(np.median(seen, axis=0), seen, GROUND, cameras(), 1.0)


def feet(boxes: list[Box]) -> Bools:
    return bodies(boxes)[0]


@pytest.mark.parametrize("height", [0.25, 0.05], ids=["a plinth", "a low foot"])
def test_a_plain_foot_below_a_bright_post_is_found_where_it_stands(height: float) -> None:
    post: Box = ((-0.1, -0.1, height), (0.1, 0.1, 0.9), WHITE)
    found = feet([((-0.4, -0.3, 0.0), (0.4, 0.3, height), BLACK), post])
    place = ((np.arange(N) + 0.5) / N * 2 - 1) * REACH
    x, y = np.meshgrid(place, place)
    true = (np.abs(x) < 0.4) & (np.abs(y) < 0.3)
    assert (found & true).sum() / (found | true).sum() > 0.85


def test_a_foot_is_found_that_looks_much_like_a_part_of_the_table() -> None:
    foot: Box = ((-0.4, -0.3, 0.0), (0.4, 0.3, 0.06), BLACK)
    post: Box = ((-0.1, -0.1, 0.06), (0.1, 0.1, 0.9), WHITE)
    seen = shown([foot, post], strip=BLACK + 0.28)
    found = plain_bodies(np.median(seen, axis=0), seen, GROUND, cameras(), 1.0)[0]
    place = ((np.arange(N) + 0.5) / N * 2 - 1) * REACH
    x, y = np.meshgrid(place, place)
    true = (np.abs(x) < 0.4) & (np.abs(y) < 0.3)
    assert (found & true).sum() / (found | true).sum() > 0.8


def test_a_shadow_round_a_dark_body_is_not_taken_for_its_foot() -> None:
    place = ((np.arange(N) + 0.5) / N * 2 - 1) * REACH
    away = np.hypot(*np.meshgrid(place, place))
    bare, seen = shown([]), shown([((-0.2, -0.2, 0.0), (0.2, 0.2, 0.8), TABLE - 1.0)])
    hidden = (seen != bare).any(-1, keepdims=True)
    shade = (TABLE - 1.5 * np.exp(-((away / 0.35) ** 2)))[..., None]
    plane = np.where(away[..., None] < 0.8, shade, np.median(bare, axis=0))
    seen = np.where(hidden, seen, plane).astype(np.float32)
    found = plain_bodies(np.median(seen, axis=0), seen, GROUND, cameras(), 1.0)[0]
    assert not found[away > 0.3].any()


@pytest.mark.parametrize(
    "boxes",
    [[FLAT], [HANGING], []],
    ids=["paper", "a body that hangs", "nothing"],
)
def test_what_does_not_stand_is_left_alone(boxes: list[Box]) -> None:
    assert not feet(boxes).any()


def test_paper_below_a_standing_body_is_not_taken_for_its_foot() -> None:
    found = feet([FLAT, ((-0.3, -0.22, 0.0), (0.3, 0.22, 0.5), WHITE)])
    rim = round((1 - 0.35 / REACH) * N / 2)  # column where the paper shows beside the body
    assert not found[:, :rim].any()


def test_where_a_body_hangs_what_photos_agree_on_is_not_the_plane() -> None:
    stands, hangs = bodies([HANGING])
    assert hangs.any() and not stands.any()
    place = ((np.arange(N) + 0.5) / N * 2 - 1) * REACH
    x, y = np.meshgrid(place, place)
    over = (np.abs(x) < 0.5) & (np.abs(y) < 0.3)
    assert (hangs & over).sum() > 0.6 * hangs.sum()
    for boxes in ([FLAT], [], [BODY]):
        assert not bodies(boxes)[1].any()


def test_a_cell_that_no_photo_shows_does_not_hide_a_plinth() -> None:
    seen = shown([BODY])
    colour = np.median(seen, axis=0)
    colour[N // 2, N // 2] = np.nan
    assert plain_bodies(colour, seen, GROUND, cameras(), 1.0)[0].sum() > 1000
