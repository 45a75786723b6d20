"""The least light from above that photos allow."""

import numpy as np
import pytest
import torch

from refdgs_pipe.ground_light import GroundLight
from refdgs_pipe.light import texel_directions
from refdgs_pipe.texture.exposure import STANDARD, LeastLight, least_light
from refdgs_pipe.texture.mean_light import WHITE
from refdgs_pipe.texture.unknowns import State, Unknown

HEIGHT = 16
UP = texel_directions(HEIGHT).reshape(-1, 3)[:, 2]
ABOVE = np.array([[0, 0, 1.0], [1, 0, 2.0]], np.float32)


def ground(radiance: float, *, share: float = 1.0, turned: bool = False) -> GroundLight:
    """A plane of one colour with z up; `turned`: its axes make a normal that points down."""
    picture = np.full((8, 8, 4), radiance * share, np.float32)
    picture[..., 3] = share
    a, b = np.eye(3)[0], np.eye(3)[1]
    return GroundLight(picture, np.zeros(3), *((b, a) if turned else (a, b)), 2.0)


def least(radiance: float, **how: float | bool) -> LeastLight:
    found = least_light(ground(radiance, **how), ABOVE, HEIGHT)  # type: ignore[arg-type]
    assert found is not None
    return found


@pytest.mark.parametrize("turned", [False, True])
def test_a_white_surface_facing_up_shows_the_light_above(turned: bool) -> None:
    weights = least(0.1, turned=turned).weights
    assert weights.sum() == pytest.approx(1, abs=1e-5)
    assert not weights[UP < 0].any()
    # the mean of cos^2 over a half sphere, weighted by the cosine: int x^3 / int x = 1/2
    assert float(weights @ UP**2) == pytest.approx(0.5, abs=0.02)


def test_a_dark_ground_asks_for_the_light_that_cameras_are_exposed_for() -> None:
    assert least(0.05).least == pytest.approx(STANDARD)


def test_a_bright_ground_asks_for_more_because_nothing_is_whiter_than_paint() -> None:
    assert least(0.7).least == pytest.approx(0.7 / WHITE)
    assert least(0.7, share=0.75).least == pytest.approx(0.7 / WHITE)


def test_ground_that_photos_hardly_show_asks_for_nothing() -> None:
    assert least(0.9, share=0.25).least == pytest.approx(STANDARD)


def test_without_a_known_ground_any_light_will_do() -> None:
    assert least_light(None, ABOVE, HEIGHT) is None


def test_dim_light_grows_until_it_is_enough() -> None:
    """Only light from above grows; enough light costs nothing."""
    texels = 2 * HEIGHT * HEIGHT
    one, three = np.full(2, 0.5, np.float32), np.full((2, 3), 0.5, np.float32)
    dim = np.full((texels, 3), 0.2, np.float32)
    wanted = least(0.05)
    unknown = Unknown(State(dim, one, one, three, three, three), balanced=False, least=wanted)
    optimizer = torch.optim.SGD([unknown.light], lr=1000)
    for _ in range(400):
        optimizer.zero_grad()
        wanted.missing(unknown.logs().exp()).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    light = unknown.state().light
    received = float(wanted.weights @ light.mean(1))
    assert received == pytest.approx(STANDARD, rel=0.02)
    assert np.allclose(light[UP < -0.1], 0.2)
    enough = torch.full((texels, 3), 0.8)
    assert float(wanted.missing(enough)) == 0
