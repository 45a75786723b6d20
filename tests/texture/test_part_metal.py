"""Parts are told metal by what they add to their light: how much of it, and in which colour."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from refdgs_pipe.texture.part_metal import Lines

PLACES, VIEWS = 40, 12
CORNERS = csr_array(np.repeat(np.eye(PLACES), VIEWS, axis=0))
PART = np.repeat([0, 1], PLACES // 2)
GOLD, RED, WHITE = (np.array(v) for v in ((0.9, 0.7, 0.3), (0.4, 0.05, 0.05), (0.6, 0.6, 0.55)))


def lines(
    share: np.ndarray, rest: np.ndarray, *, varied: float = 0.15, counted: float = 1.0
) -> Lines:
    """Both parts send share * light + rest; the light that is known differs from it a little."""
    random = np.random.default_rng(7)
    light = 0.4 + varied * random.normal(size=(PLACES * VIEWS, 1)) * np.array([1.0, 0.95, 0.9])
    known = light + 0.3 * varied * random.normal(size=light.shape)
    chosen = random.random(len(light)) < counted
    seen = (share * light + rest).astype(np.float32)
    return Lines.of(PART, CORNERS, seen, known.astype(np.float32), chosen)


@pytest.mark.parametrize(
    ("share", "rest", "is_metal"),
    [
        (GOLD, 0 * GOLD, True),
        (np.full(3, 0.2), RED, False),  # red plastic
        (np.full(3, 0.9), 0 * RED, True),  # chrome
    ],
)
def test_metal_is_told_by_the_colour_of_what_varies(
    share: np.ndarray, rest: np.ndarray, is_metal: bool
) -> None:
    found = lines(share, rest).metal(np.array([True, False]))  # whatever was guessed
    assert (found == is_metal).all()


def test_what_does_not_tell_stays_as_guessed() -> None:
    guess = np.array([True, False])
    for given in (lines(GOLD, 0 * GOLD, varied=0.005), lines(GOLD, 0 * GOLD, counted=0.1)):
        assert not given.told.any()
        np.testing.assert_array_equal(given.metal(guess), guess)


def test_white_plastic_is_no_metal_by_itself() -> None:
    found = lines(np.full(3, 0.2), WHITE)
    assert found.told.all() and not found.metal(np.zeros(2, bool)).any()
