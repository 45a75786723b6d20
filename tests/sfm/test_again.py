"""A photo's place, found again from what only the others see."""

import numpy as np
import pytest
from scenes import look_at

from refdgs_pipe.sfm.again import Sights, moves

FOCAL = 800.0
TURNS = [15.0 * i for i in range(8)]


def scene(count: int = 60, noise: float = 0.5) -> tuple[np.ndarray, np.ndarray, Sights]:
    """Eight cameras in an arc at distance 4; each sees all points with some pixels of noise."""
    rng = np.random.default_rng(1)
    points = rng.normal(0, 0.4, (count, 3))
    eyes = [4 * np.array([0.9 * np.cos(a), 0.9 * np.sin(a), 0.43]) for a in np.radians(TURNS)]
    poses = np.stack([look_at("a", eye).cam_from_world for eye in eyes])
    photo, point = (a.ravel() for a in np.meshgrid(range(len(poses)), range(count), indexing="ij"))
    x = np.einsum("nij,nj->ni", poses[photo, :3, :3], points[point]) + poses[photo, :3, 3]
    ray = x[:, :2] / x[:, 2:] + rng.normal(0, noise / FOCAL, (len(x), 2))
    return poses, points, Sights(photo, point, ray)


PIXEL = np.full(len(TURNS), 1 / FOCAL)


def test_places_that_the_others_confirm_hardly_move() -> None:
    found = moves(*scene(), PIXEL)
    assert (found < 0.004).all() and (found > 0).all()


@pytest.mark.parametrize("shift", [0.05, 0.4])
def test_a_wrong_place_moves_to_where_the_others_put_it(shift: float) -> None:
    poses, points, sights = scene()
    poses[3, :3, 3] += shift * np.array([0.6, 0.0, 0.8])
    found = moves(poses, points, sights, PIXEL)
    assert found[3] == pytest.approx(shift / 4, rel=0.2)
    assert (np.delete(found, 3) < 0.3 * found[3]).all()


def test_a_few_wrong_matches_do_not_move_a_place() -> None:
    poses, points, sights = scene()
    wrong = np.flatnonzero(sights.photo == 2)[:6]
    sights.ray[wrong] += 0.1
    assert moves(poses, points, sights, PIXEL)[2] < 0.01


def test_a_photo_that_the_others_do_not_hold_has_no_answer() -> None:
    poses, points, sights = scene()
    seen_by_one = (sights.photo != 5) | (sights.point < 5)
    few = Sights(*(a[seen_by_one] for a in (sights.photo, sights.point, sights.ray)))
    found = moves(poses, points, few, PIXEL)
    assert np.isinf(found[5]) and np.isfinite(np.delete(found, 5)).all()


def test_points_that_one_other_photo_sees_tell_nothing() -> None:
    poses, points, sights = scene()
    two = (sights.photo == 0) | (sights.photo == 1)
    pair = Sights(*(a[two] for a in (sights.photo, sights.point, sights.ray)))
    assert np.isinf(moves(poses, points, pair, PIXEL)).all()


def test_points_behind_a_camera_do_not_confirm_its_place() -> None:
    """A photo that looks the other way from its place: every point lies behind it."""
    poses, points, sights = scene()
    poses[4, :3] = np.diag([1.0, -1.0, -1.0]) @ poses[4, :3]
    assert np.isinf(moves(poses, points, sights, PIXEL)[4])


def test_rays_and_points_without_a_number_are_left_out() -> None:
    """A mapper's lens can go astray so far that pixels have no ray."""
    poses, points, sights = scene()
    sights.ray[np.flatnonzero(sights.photo == 2)[:9]] = np.nan
    sights.ray[np.flatnonzero(sights.photo == 3)[:9]] = 1e200
    points[20] = np.inf
    poses[6, 0, 3] = np.nan
    found = moves(poses, points, sights, PIXEL)
    assert np.isinf(found[6]) and (np.delete(found, 6) < 0.01).all()
