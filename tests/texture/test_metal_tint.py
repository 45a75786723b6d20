"""The colour of metals and the unit of the far light, from samples that mirror both lights."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from refdgs_pipe.texture.metal_tint import Mirrored, even_tint

COPPER = np.array([0.95, 0.62, 0.51])
SIDE, VIEWS = 20, 12
COUNT = SIDE * SIDE


def links() -> np.ndarray:
    """(E, 2) of a sheet of SIDE x SIDE vertices."""
    index = np.arange(COUNT).reshape(SIDE, SIDE)
    across = np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1)
    down = np.stack([index[:-1].ravel(), index[1:].ravel()], 1)
    return np.concatenate([across, down])


def sheet(tint: np.ndarray, unit: float, *, wrong: bool = False) -> Mirrored:
    """Lower vertices mirror brown ground, upper ones the sky, those between some of both.

    Args:
        tint: (V, 3); unit: of the sky, whose given light is 1 / unit of the true one.
        wrong: whether a few rays below the horizon are given sky that they do not mirror.
    """
    random = np.random.default_rng(5)
    vertex = np.repeat(np.arange(COUNT), VIEWS)
    share = np.clip((vertex // SIDE) / (SIDE - 1) + 0.2 * random.normal(size=len(vertex)), 0, 1)
    share = share[:, None].astype(np.float32)
    ground = share * np.array([0.2, 0.09, 0.03]) * random.uniform(0.7, 1.3, (len(vertex), 1))
    sky = (1 - share) * random.uniform(0.5, 1.0, (len(vertex), 3))
    seen = 0.95 * tint[vertex] * (ground + sky) + 0.01 * (ground + sky)
    given = sky / unit
    if wrong:
        stray = random.random(len(vertex)) < 0.1
        given[stray & (share[:, 0] > 0.7)] += 0.2
    corners = csr_array(
        (np.ones(len(vertex), np.float32), (np.arange(len(vertex)), vertex)),
        shape=(len(vertex), COUNT),
    )
    ones = np.ones((len(vertex), 1), np.float32)
    parts = [seen, ground, given, share, 0.95 * ones, 0.01 * ones]
    return Mirrored(*(np.asarray(part, np.float32) for part in parts), corners)


@pytest.mark.parametrize("unit", [0.6, 1.0, 1.9])
@pytest.mark.parametrize("wrong", [False, True])
def test_one_metal_tells_its_colour_and_how_bright_the_far_light_is(
    unit: float, wrong: bool
) -> None:
    tint = np.tile(COPPER, (COUNT, 1))
    mirrored = sheet(tint, unit, wrong=wrong)
    colors = np.full((COUNT, 3), 0.3, np.float32)
    found, told = even_tint(mirrored, np.ones(COUNT, np.bool_), colors, links())
    assert found == pytest.approx(unit, rel=0.2)
    assert np.abs(told.mean(0) - COPPER).max() < 0.08
    assert told.std(0).max() < 0.03


def test_two_metals_that_look_unlike_keep_their_colours() -> None:
    left = np.arange(COUNT) % SIDE < SIDE // 2
    tint = np.where(left[:, None], COPPER, 0.9)
    colors = np.where(left[:, None], 0.5 * COPPER, 0.9).astype(np.float32)
    _, told = even_tint(sheet(tint, 1.0), np.ones(COUNT, np.bool_), colors, links())
    assert np.abs(told[left].mean(0) - COPPER).max() < 0.08
    assert np.abs(told[~left].mean(0) - 0.9).max() < 0.08


def test_without_metal_nothing_is_told() -> None:
    mirrored = sheet(np.full((COUNT, 3), 0.5), 1.0)
    colors = np.full((COUNT, 3), 0.3, np.float32)
    assert even_tint(mirrored, np.zeros(COUNT, np.bool_), colors, links())[0] == 1.0
