"""Figures whose value is known beforehand."""

import math

import numpy as np
import pytest

from refdgs_pipe.metrics import (
    SurfaceDistances,
    angle_deg,
    depth_error,
    mask_iou,
    nearest,
    normal_error_deg,
    normal_error_over_white_deg,
    psnr,
    psnr_per_channel,
)

ALL = np.ones((40, 30), bool)


def normals(seed: int = 0) -> np.ndarray:
    """(40, 30, 3) unit."""
    vectors = np.random.default_rng(seed).normal(size=(40, 30, 3))
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def turned(normal: np.ndarray, degrees: float) -> np.ndarray:
    """Each normal turned by that angle about an axis across it."""
    across = np.cross(normal, [0.3, -0.5, 0.8])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.radians(degrees)
    return (np.cos(angle) * normal + np.sin(angle) * across).astype(np.float32)


def test_normals_turned_by_five_degrees_are_five_degrees_off() -> None:
    truth = normals()
    assert normal_error_deg(turned(truth, 5), truth, ALL) == pytest.approx(5, abs=1e-3)
    opaque = np.ones(ALL.shape, np.float32)
    over_white = normal_error_over_white_deg(turned(truth, 5), opaque, truth)
    assert over_white == pytest.approx(5, abs=1e-3)


def test_equal_normals_are_exactly_zero_off() -> None:
    truth = normals()
    assert normal_error_deg(truth, truth, ALL) == 0
    assert angle_deg(truth * 7, truth).max() < 1e-5  # float32 rounds the product


def test_the_all_pixel_error_dilutes_the_object_by_its_share() -> None:
    truth, alpha = normals(), np.zeros(ALL.shape, np.float32)
    alpha[:10] = 1
    white = np.where(alpha[..., None] > 0, truth, np.float32(1))
    seen = np.where(alpha[..., None] > 0, turned(truth, 5), 0).astype(np.float32)
    assert normal_error_over_white_deg(seen, alpha, white) == pytest.approx(5 / 4, abs=1e-3)


def test_an_alpha_of_99_percent_costs_what_the_formula_says() -> None:
    truth = np.broadcast_to(np.float32([1, -1, 0]) / np.float32(math.sqrt(2)), (4, 4, 3))
    mixed = 0.99 * truth[0, 0].astype(float) + 0.01
    cosine = mixed @ truth[0, 0] / np.linalg.norm(mixed)
    error = normal_error_over_white_deg(truth, np.full((4, 4), 0.99, np.float32), truth)
    assert error == pytest.approx(np.degrees(np.arccos(cosine)), abs=1e-4)


def test_a_missing_normal_counts_as_a_right_angle() -> None:
    assert normal_error_deg(np.zeros((40, 30, 3), np.float32), normals(), ALL) == pytest.approx(90)


def test_psnr_is_its_formula_and_the_mean_over_channels_is_not_less() -> None:
    target = np.full((8, 8, 3), 0.5, np.float32)
    image = target + np.float32([0.1, 0.01, 0.001])
    mse = np.mean((image.astype(float) - target) ** 2)
    assert psnr(image, target) == pytest.approx(-10 * math.log10(mse))
    assert psnr_per_channel(image, target) == pytest.approx(40, abs=1e-3)  # (20 + 40 + 60) / 3
    assert psnr(target, target) == 120


def test_depth_and_masks() -> None:
    depth = np.full((4, 4), 2.0, np.float32)
    assert depth_error(depth + np.float32(0.25), depth, depth > 0) == pytest.approx(0.25)
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert mask_iou(a, b) == 1
    a[:2], b[1:3] = True, True
    assert mask_iou(a, b) == pytest.approx(1 / 3)


def test_surface_distances_have_their_textbook_values() -> None:
    here, there = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0.1]])
    found = SurfaceDistances(nearest(here, there), nearest(there, here))
    assert found.completeness == pytest.approx(0.1)
    assert found.accuracy == pytest.approx((0.1 + math.sqrt(1.01)) / 2)
    assert found.chamfer == pytest.approx((found.accuracy + found.completeness) / 2)
    assert found.f_score(0.2) == pytest.approx(2 * 0.5 * 1 / 1.5)
    assert found.f_score(0.05) == 0
