"""Poses and lenses from places on a plane: derivatives, and what comes back."""

import cv2
import numpy as np
from captures import looking

from refdgs_pipe.ground.adjust import Sight, State, _moved, _project, adjusted, misses, seen

K = np.array([[600.0, 0, 320], [0, 610, 240], [0, 0, 1]])
NONE = np.zeros(2)


def pose(around: float, up: float) -> np.ndarray:
    """Looks at the origin from 4 away; degrees."""
    a, e = np.radians(around), np.radians(up)
    return looking(4 * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)]))


def test_derivatives_match_finite_differences() -> None:
    points = np.random.default_rng(0).normal(size=(5, 3))
    at, lens, step = pose(30, 20), np.array([0.01, 0.05]), 1e-6
    _, by_pose, by_lens = _project(K, at, lens, points)
    for k in range(6):
        d = np.eye(6)[k] * step
        ahead, behind = (seen_by(_moved(at, s * d), lens, points) for s in (1, -1))
        np.testing.assert_allclose(by_pose[:, :, k], (ahead - behind) / (2 * step), rtol=1e-5)
    for k in range(2):
        d = np.eye(2)[k] * step
        ahead, behind = (seen_by(at, lens + s * d, points) for s in (1, -1))
        np.testing.assert_allclose(by_lens[:, :, k], (ahead - behind) / (2 * step), rtol=1e-5)


def seen_by(at: np.ndarray, lens: np.ndarray, points: np.ndarray) -> np.ndarray:
    return _project(K, at, lens, points)[0]


def sights(poses: list[np.ndarray], lens: np.ndarray) -> list[Sight]:
    """What photos with these poses, through this lens, show of two hundred places of a plane.

    The sparse points are said to be where photos with slightly wrong poses would show them.
    """
    rng = np.random.default_rng(1)
    places = np.c_[rng.uniform(-1, 1, (200, 2)), np.zeros(200)]
    solid = rng.uniform(-0.5, 0.5, (20, 3))
    return [
        Sight(K, places, seen_by(p, lens, places), solid, seen_by(p, lens, solid) + 0.5, 0)
        for p in poses
    ]


def off(poses: list[np.ndarray]) -> np.ndarray:
    """The same poses, turned and shifted a little."""
    rng = np.random.default_rng(2)
    return np.stack([_moved(p, rng.normal(size=6) * 0.01) for p in poses])


def test_poses_come_back_also_among_places_that_are_wrong() -> None:
    true = [pose(a, e) for a, e in ((0, 15), (70, 40), (140, 20), (210, 60), (280, 30))]
    given = sights(true, NONE)
    for sight in given:
        sight.pixels[::5] += 25  # a fifth was found in the wrong place
    state, _ = adjusted(given, State(off(true), np.zeros((1, 2))), free_lenses=False)
    for sight, one in zip(given, state.poses, strict=True):
        assert np.median(misses(sight, one, NONE)) < 0.1
    assert not state.lenses.any()
    np.testing.assert_allclose(state.poses, true, atol=2e-3)


def test_a_lens_that_all_photos_share_comes_back() -> None:
    true = [pose(a, e) for a, e in ((0, 15), (70, 40), (140, 20), (210, 60), (280, 30))]
    lens = np.array([0.004, 0.03])
    state, cost = adjusted(sights(true, lens), State(off(true), np.zeros((1, 2))), free_lenses=True)
    _, fixed = adjusted(sights(true, lens), State(off(true), np.zeros((1, 2))), free_lenses=False)
    np.testing.assert_allclose(state.lenses[0], lens, rtol=0.2)
    assert cost < 0.7 * fixed


def test_a_photo_that_shows_no_place_follows_its_sparse_points() -> None:
    at = pose(30, 30)
    solid = np.random.default_rng(3).uniform(-0.5, 0.5, (20, 3))
    nowhere = np.zeros((0, 3)), np.zeros((0, 2))
    sight = Sight(K, *nowhere, solid, seen_by(at, NONE, solid), 0)
    wrong = _moved(at, np.full(6, 0.01))
    state, _ = adjusted([sight], State(wrong[None], np.zeros((1, 2))), free_lenses=False)
    assert np.abs(seen(sight, state.poses[0], NONE, solid) - sight.at).max() < 0.01
    assert cv2.norm(state.poses[0] - at) < 1e-3
