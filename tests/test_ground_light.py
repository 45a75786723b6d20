"""The ground is mirrored where it lies, blurred as roughness and distance ask."""

import numpy as np
import pytest

from refdgs_pipe.ground_light import GroundLight, at_roughness
from refdgs_pipe.light import ROUGHNESSES

N, RADIUS = 128, 2.0
A, B = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
DOWN = np.array([[0, 0, -1.0]], np.float32)


def ground(picture: np.ndarray, known: np.ndarray | None = None) -> GroundLight:
    """A picture (N, N) or (N, N, 3) of the plane z = 0."""
    color = np.broadcast_to(picture[..., None] if picture.ndim == 2 else picture, (N, N, 3))
    share = np.ones((N, N)) if known is None else known.astype(float)
    whole = np.dstack([color * share[..., None], share]).astype(np.float32)
    return GroundLight(whole, np.zeros(3), A, B, RADIUS)


def place() -> tuple[np.ndarray, np.ndarray]:
    x = ((np.arange(N) + 0.5) / N * 2 - 1) * RADIUS
    return np.meshgrid(x, x)


def met(light: GroundLight, point: list[float], way: np.ndarray, rough: float) -> np.ndarray:
    one = np.asarray([point], np.float32)
    return light.mirrored(one, way.astype(np.float32), np.full(1, rough, np.float32))[0]


def test_a_sharp_ray_shows_the_place_that_it_meets() -> None:
    x, y = place()
    light = ground(np.dstack([0.5 + 0.2 * x, 0.5 + 0.2 * y, 0 * x]))
    way = np.array([[0.6, 0, -0.8]])
    shown = met(light, [0.2, -0.7, 0.4], way, 0.05)
    assert np.allclose(shown, [0.5 + 0.2 * 0.5, 0.5 - 0.2 * 0.7, 0, 1], atol=2e-3)


@pytest.mark.parametrize("way", [[0, 0, 1.0], [1.0, 0, 0], [0.9999, 0, -0.015]])
def test_rays_that_do_not_meet_the_picture_show_nothing(way: list[float]) -> None:
    assert not met(ground(np.ones((N, N))), [0, 0, 0.5], np.array([way]), 0.2).any()


def test_a_ray_that_starts_below_shows_nothing() -> None:
    assert not met(ground(np.ones((N, N))), [0, 0, -0.5], DOWN, 0.2).any()


def test_the_rougher_and_the_farther_the_more_is_blurred() -> None:
    x, _ = place()
    light = ground((np.floor(x / 0.125) % 2).astype(float))
    rows = np.linspace(-0.6, 0.6, 40)

    def contrast(height: float, rough: float) -> float:
        seen = [met(light, [at, 0, height], DOWN, rough)[0] for at in rows]
        return float(np.std(seen))

    sharp = contrast(0.2, 0.1)
    assert sharp > 0.4
    assert contrast(0.2, 0.5) < 0.5 * sharp
    assert contrast(0.8, 0.3) < 0.5 * contrast(0.2, 0.3)


def test_what_is_not_known_has_no_share() -> None:
    x, _ = place()
    light = ground(np.ones((N, N)), known=x < 0)
    assert met(light, [0.8, 0, 0.2], DOWN, 0.1)[3] == 0
    half = met(light, [0, 0, 0.5], DOWN, 0.5)
    assert 0.3 < half[3] < 0.7 and np.allclose(half[:3], half[3], atol=1e-5)


def test_a_wide_lobe_along_the_ground_is_shared_with_the_room() -> None:
    light = ground(np.ones((N, N)))
    flat = np.array([[np.cos(0.1), 0, -np.sin(0.1)]])
    assert met(light, [-1.0, 0, 0.1], flat, 0.1)[3] > 0.95
    assert met(light, [-1.0, 0, 0.1], flat, 0.6)[3] < 0.3


def test_levels_are_what_is_mirrored_at_each_roughness() -> None:
    x, _ = place()
    light = ground(0.5 + 0.2 * x)
    points = np.array([[0.1, 0.2, 0.3]], np.float32)
    levels = light.levels(points, DOWN)
    for i, rough in enumerate(ROUGHNESSES):
        alone = light.mirrored(points, DOWN, np.full(1, rough, np.float32))
        assert np.allclose(levels[:, i], alone)
        assert np.allclose(at_roughness(levels, np.full(1, rough, np.float32)), alone, atol=1e-6)
