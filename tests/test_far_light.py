"""The ground that a place sees and the far light beside it make up one lobe."""

import numpy as np
import pytest

from refdgs_pipe.far_light import FarLight, ground_seen
from refdgs_pipe.ground_light import GroundLight
from refdgs_pipe.light import Environment, texel_directions

HEIGHT = 32
BROWN, SKY = np.array([0.2, 0.09, 0.03], np.float32), np.array([0.7, 0.7, 0.7], np.float32)
A, B = np.eye(3)[0], np.eye(3)[1]
BALL = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]], np.float32)  # its corners


def wide() -> GroundLight:
    """An even brown ground, z = 0, that reaches to the horizon."""
    picture = np.ones((64, 64, 4), np.float32)
    picture[..., :3] = BROWN
    return GroundLight(picture, np.zeros(3), A, B, 500.0)


def parts() -> tuple[GroundLight, FarLight, np.ndarray]:
    ground = wide()
    told, known = ground_seen(ground, BALL, HEIGHT)
    light = np.where(known[:, None], told, SKY).astype(np.float32)
    return ground, FarLight(light, known), light


def ways(fall: float) -> np.ndarray:
    """(8, 3) unit directions that fall by so many degrees."""
    turn = np.arange(8) * np.pi / 4
    level, down = np.cos(np.radians(fall)), -np.sin(np.radians(fall))
    return np.stack([level * np.cos(turn), level * np.sin(turn), np.full(8, down)], 1).astype("f4")


def test_the_middle_sees_the_ground_below_the_horizon() -> None:
    told, known = ground_seen(wide(), BALL, HEIGHT)
    below = texel_directions(HEIGHT).reshape(-1, 3)[:, 2] < -0.05
    assert known[below].all() and not known[~below][:HEIGHT].any()
    assert np.allclose(told[known], BROWN, atol=1e-3)


def test_without_a_ground_nothing_is_known() -> None:
    assert not ground_seen(None, BALL, HEIGHT)[1].any()


@pytest.mark.parametrize("rough", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("fall", [-40, 15, 40, 70])
def test_an_even_ground_that_has_no_end_looks_as_if_it_were_far_away(
    rough: float, fall: float
) -> None:
    """Then nothing depends on where the place is, and the far picture alone is right."""
    ground, around, light = parts()
    roughness = np.full(8, rough, np.float32)
    whole = Environment(light.reshape(HEIGHT, -1, 3)).mirrored(ways(fall), roughness)
    for height in (0.05, 0.5, 1.0):
        points = np.tile(np.array([0.3, 0, height], np.float32), (8, 1))
        found = around.mirrored(ground, points, ways(fall), roughness)
        assert np.abs(found - whole).max() < 0.02


def test_a_sharp_ray_shows_the_place_that_it_meets() -> None:
    ground, around, _ = parts()
    picture = ground.picture.copy()
    picture[:, :32, :3] = 0.6  # where x < 0
    near = GroundLight(picture, ground.origin, A, B, 500.0)
    points = np.array([[100.0, 0, 1], [-100.0, 0, 1]], np.float32)
    down = np.tile(np.array([0, 0, -1], np.float32), (2, 1))
    found = around.mirrored(near, points, down, np.full(2, 0.1, np.float32))
    assert np.allclose(found, [BROWN, [0.6] * 3], atol=0.01)
