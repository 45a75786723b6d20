"""Parts of one colour are told apart by hue, however unevenly they are lit."""

import numpy as np

from refdgs_pipe.texture.one_colour import mean_over_parts, parts_of_one_colour

SIDE = 40
INDEX = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
LINKS = np.concatenate(
    [
        np.stack([INDEX[:-1].ravel(), INDEX[1:].ravel()], 1),
        np.stack([INDEX[:, :-1].ravel(), INDEX[:, 1:].ravel()], 1),
    ]
)
X, Y = (axis.ravel() for axis in np.meshgrid(np.arange(SIDE), np.arange(SIDE)))
LEFT = X < SIDE // 2


def seen(left: tuple[float, ...], right: tuple[float, ...], shade: np.ndarray) -> np.ndarray:
    """(V, 3) two halves of their own colours, lit by `shade` (V,), with noise."""
    noise = np.random.default_rng(4).normal(1, 0.02, (SIDE * SIDE, 3))
    return np.where(LEFT[:, None], left, right) * shade[:, None] * noise


def test_two_colours_are_two_parts_in_uneven_light() -> None:
    shade = np.where(Y < 15, 0.7, 0.9)  # a wall and a top
    colors = seen((0.6, 0.55, 0.4), (0.6, 0.45, 0.15), shade)
    part = parts_of_one_colour(colors, LINKS)
    assert len(np.unique(part[LEFT])) == len(np.unique(part[~LEFT])) == 1
    assert part[LEFT][0] != part[~LEFT][0]


def test_equal_hues_of_very_unequal_brightness_are_two_parts() -> None:
    part = parts_of_one_colour(seen((0.7, 0.7, 0.7), (0.05, 0.05, 0.05), np.ones(SIDE**2)), LINKS)
    assert not np.isin(part[LEFT], part[~LEFT]).any()


def test_what_few_places_of_a_part_say_is_overruled() -> None:
    colors = seen((0.6, 0.55, 0.4), (0.6, 0.45, 0.15), np.ones(SIDE**2))
    value = np.where(LEFT, 0.0, 1.0).astype(np.float32)
    value[LEFT & (X > 12) & (Y > 10) & (Y < 25)] = 1
    part = parts_of_one_colour(colors, LINKS)
    found = mean_over_parts(value, np.ones(SIDE**2), part)[part]
    assert found[LEFT].max() < 0.2 and found[~LEFT].min() == 1


def test_vertices_without_neighbours_are_parts_of_their_own() -> None:
    same, none = np.full((2, 3), 0.5, np.float32), np.zeros((0, 2), np.int64)
    assert set(parts_of_one_colour(same, none)) == {0, 1}
