"""The world turned to +Y up, directions round an object, and pictures seen through planes."""

import numpy as np
import pytest
from scenes import look_at

from refdgs_pipe.color import fractions, srgb_from_linear, srgb_slope
from refdgs_pipe.geometry import (
    homography_warp,
    one_sided,
    outline_distance,
    robust_similarity,
    spread_over,
    through_plane,
    widest_stretch,
    y_up_from_z_up,
)
from refdgs_pipe.vectors import unit


def test_z_up_becomes_y_up_by_the_quarter_turn_of_every_tool() -> None:
    turn = y_up_from_z_up(np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(turn @ [1, 2, 3], [1, 3, -2], atol=1e-12)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (0, 1, 0), (0.3, -0.5, 0.2), (1, 0, 0)])
def test_any_up_becomes_plus_y_without_mirroring(up: tuple[float, float, float]) -> None:
    turn = y_up_from_z_up(np.array(up, float))
    np.testing.assert_allclose(turn @ up / np.linalg.norm(up), [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) > 0


def test_the_widest_stretch_may_go_over_the_back() -> None:
    assert widest_stretch([-90.0, 0.0, 90.0]) == (90.0, 270.0)
    assert widest_stretch([-170.0, 20.0, 170.0]) == (-170.0, 20.0)
    assert widest_stretch([5.0]) == (5.0, 365.0)


@pytest.mark.parametrize("wrong", ["source", "target"])
def test_a_point_a_million_times_farther_away_does_not_turn_the_others(wrong: str) -> None:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(32, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    target = 1.7 * source @ turn.T + [3.0, -1.0, 2.0]
    (source if wrong == "source" else target)[4] = [1e6, 3e5, -2e5]
    world = robust_similarity(source, target)
    misses = np.linalg.norm(source @ world[:3, :3].T + world[:3, 3] - target, axis=1)
    assert np.delete(misses, 4).max() < 1e-3


@pytest.mark.parametrize("spread, expected", [(50, True), (100, True), (120, False), (170, False)])
def test_photos_within_half_a_turn_are_from_one_side(spread: float, expected: bool) -> None:
    angles = np.radians(np.linspace(-spread, spread, 15))
    cameras = tuple(
        look_at(f"{i}", np.array([np.cos(a), np.sin(a), 0.4])) for i, a in enumerate(angles)
    )
    assert one_sided(cameras, np.zeros(3), np.array([0.0, 0.0, 1.0])) is expected


def test_a_plane_of_equal_depth_takes_pixels_to_where_the_other_photo_sees_them() -> None:
    one, other = look_at("a", np.array([3.0, 0, 1])), look_at("b", np.array([2.8, 0.6, 1.2]))
    pixel, depth = np.array([70.5, 90.5, 1.0]), 2.7
    point = np.linalg.inv(one.K) @ pixel * depth
    world = one.world_from_cam[:3, :3] @ point + one.world_from_cam[:3, 3]
    expected, _ = other.project(world[None])
    x, y, w = through_plane(one, other, 1 / depth) @ pixel
    np.testing.assert_allclose([x / w, y / w], expected[0], atol=1e-9)


def test_a_picture_moved_by_whole_pixels_stays_sharp() -> None:
    picture = np.random.default_rng(0).random((8, 9)).astype(np.float32)
    moved = homography_warp(picture, np.array([[1, 0, 2], [0, 1, 1], [0, 0, 1.0]]), 9, 8, -1.0)
    np.testing.assert_allclose(moved[:-1, :-2], picture[1:, 2:], atol=1e-6)
    assert (moved[-1] == -1).all()


def test_units_have_length_1_in_their_own_type_and_zero_stays_zero() -> None:
    for dtype in (np.float32, np.float64):
        rng = np.random.default_rng(1)
        vectors = (rng.normal(size=(4, 5, 3)) * 10.0 ** rng.integers(-6, 6, (4, 5, 1))).astype(
            dtype
        )
        vectors[0, 0] = 0
        found = unit(vectors)
        length = np.linalg.norm(found, axis=-1)
        assert found.dtype == dtype and length[0, 0] == 0
        assert np.allclose(length.ravel()[1:], 1, atol=1e-6)


def test_the_slope_of_the_srgb_curve_is_its_difference() -> None:
    linear = np.array([0.01, 0.1, 0.5, 0.9], np.float32)
    step = np.float32(1e-3)
    wanted = (srgb_from_linear(linear + step) - srgb_from_linear(linear - step)) / (2 * step)
    assert np.allclose(srgb_slope(linear), wanted, rtol=2e-3)
    assert srgb_slope(np.array([1.5], np.float32))[0] == 0  # clipped


def test_whole_numbers_of_both_sizes_become_fractions() -> None:
    assert fractions(np.array([0, 255], np.uint8)).tolist() == [0, 1]
    assert fractions(np.array([0, 65535], np.uint16)).tolist() == [0, 1]


@pytest.mark.parametrize("toward", [(0.0, 0.0, 0.0), (0.6, -0.3, 0.2), (-0.9, 0.2, 0.5)])
def test_a_camera_knows_in_which_pixels_a_ball_can_be_seen(
    toward: tuple[float, float, float],
) -> None:
    camera = look_at("a", np.array([3.0, 1.0, 1.0]))
    center, radius = np.array(toward), 0.25
    normals = unit(np.random.default_rng(0).normal(size=(20000, 3)))
    pixels, _ = camera.project(center + radius * normals)
    box = camera.box_of(center, radius)
    assert box is not None
    ends = np.concatenate([pixels.min(0), pixels.max(0)])[[0, 2, 1, 3]]
    inside = np.clip(ends, 0, [camera.width, camera.width, camera.height, camera.height])
    assert (np.abs(np.array(box) - inside) < 1.2).all()
    part = camera.framed(center, radius)
    left, _, top, _ = camera.frame(center, radius)
    assert left <= box[0] and top <= box[2]
    moved, _ = part.project(center[None])
    whole, _ = camera.project(center[None])
    np.testing.assert_allclose(moved, whole - [left, top], atol=1e-9)


def test_a_ball_around_the_camera_is_everywhere_and_one_aside_nowhere() -> None:
    camera = look_at("a", np.array([3.0, 0.0, 0.0]))
    assert camera.box_of(camera.center, 0.5) == (0, camera.width, 0, camera.height)
    assert camera.box_of(np.array([2.0, 40.0, 0.0]), 0.5) is None
    assert camera.frame(np.array([2.0, 40.0, 0.0]), 0.5) == (0, camera.width, 0, camera.height)


def test_an_outline_lies_between_the_pixels_on_both_sides() -> None:
    covered = np.zeros((5, 9), bool)
    covered[:, 4:] = True
    np.testing.assert_allclose(outline_distance(covered)[2], np.arange(9) - 3.5, atol=1e-6)


def test_places_are_spread_evenly_over_the_area_of_a_mesh() -> None:
    corners = np.array([[0, 0, 0], [3, 0, 0], [3, 1, 0], [0, 1, 0], [0, 2, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [3, 2, 4]], np.int32)  # areas 3 : 3 : 3
    face, weights = spread_over(corners, faces, 3000, 0)
    np.testing.assert_allclose(np.bincount(face) / 3000, [1 / 3] * 3, atol=1e-3)
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    assert (weights >= 0).all() and np.abs(weights.mean(0) - 1 / 3).max() < 0.02
    flat, _ = spread_over(corners * 0, faces, 10, 0)
    assert len(flat) == 0
