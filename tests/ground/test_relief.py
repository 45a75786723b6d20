"""How far the ground is from its plane, from where many photos show its print."""

import numpy as np

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.relief import Places, lifted, relief

RADIUS, REACH = 2.0, 2.5
GROUND = Ground.under(
    Ball(np.array([0.0, 0, 0.8]), RADIUS), np.array([0, 0, 1.0]), 0.0, REACH * RADIUS
)


def hill(xy: np.ndarray) -> np.ndarray:
    """(N,) heights of a hill as high as a twentieth of the ball's radius."""
    return np.asarray(0.1 * np.exp(-((xy - [1.0, 0.5]) ** 2).sum(1) / 2))


def shown(wrong: int = 0) -> list[Places]:
    """What twenty photos show of points on the hill; the first `wrong` are turned a little."""
    rng = np.random.default_rng(0)
    out = []
    for i in range(20):
        around, up = np.radians(18 * i), np.radians((20, 50)[i % 2])
        center = 8 * np.array(
            [np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)]
        )
        flat = np.c_[rng.uniform(-4, 4, (400, 2)), np.zeros(400)]
        raised = flat + hill(flat[:, :2])[:, None] * [0, 0, 1]
        rays = raised - center
        where = center - rays * (center[2] / rays[:, 2])[:, None]
        if i < wrong:
            where[:, :2] += 0.2
        out.append(Places.of(GROUND, center, flat, where, RADIUS))
    return out


def worst(found: np.ndarray) -> float:
    """How far lifted points are from the hill at most, in shares of the ball's radius."""
    flat = np.c_[np.random.default_rng(1).uniform(-3, 3, (500, 2)), np.zeros(500)]
    true = flat + hill(flat[:, :2])[:, None] * [0, 0, 1]
    return float(np.linalg.norm(lifted(GROUND, flat, found, RADIUS) - true, axis=1).max() / RADIUS)


def test_a_hill_is_found() -> None:
    assert worst(np.zeros((48, 48, 3))) > 0.04
    assert worst(relief(shown(), REACH)) < 0.004


def test_photos_that_are_off_hardly_change_it() -> None:
    assert worst(relief(shown(wrong=3), REACH)) < 0.01


def test_where_no_photo_shows_a_place_the_ground_is_flat() -> None:
    near = [
        Places(p.at[k], p.miss[k], p.away[k], p.sine[k])
        for p in shown()
        for k in [np.linalg.norm(p.at, axis=1) < 0.8]
    ]
    found = relief(near, REACH)
    assert np.abs(found[:6, :6]).max() < 1e-6
