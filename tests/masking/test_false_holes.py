"""Holes of a mask are kept only where an edge of the photo goes round them."""

import cv2
import numpy as np

from refdgs_pipe.masking.cut import without_false_holes

SIDE = 120


def ring(hole: bool) -> tuple[np.ndarray, np.ndarray]:
    """A light disc before a darker ground, with a hole through it or not; and its true mask."""
    picture, mask = np.full((SIDE, SIDE), 0.6, np.float32), np.zeros((SIDE, SIDE), np.uint8)
    cv2.circle(mask, (60, 60), 45, 1, -1)
    if hole:
        cv2.circle(mask, (60, 60), 15, 0, -1)
    picture[mask > 0] = 0.8
    return cv2.merge([picture] * 3), mask.astype(np.float32)


def test_a_true_hole_stays() -> None:
    rgb, mask = ring(hole=True)
    assert np.array_equal(without_false_holes(mask, rgb), mask)


def test_a_hole_without_an_edge_is_filled() -> None:
    rgb, true = ring(hole=False)
    _, torn = ring(hole=True)
    assert np.array_equal(without_false_holes(torn, rgb), true)


def test_a_hole_that_the_solid_has_too_stays() -> None:
    rgb, true = ring(hole=False)
    _, torn = ring(hole=True)
    assert np.array_equal(without_false_holes(torn, rgb, torn > 0.5), torn)
    assert np.array_equal(without_false_holes(torn, rgb, true > 0.5), true)


def test_what_lies_outside_stays_and_so_does_a_mask_of_nothing() -> None:
    rgb, true = ring(hole=False)
    assert np.array_equal(without_false_holes(true, rgb), true)
    nothing = np.zeros_like(true)
    assert np.array_equal(without_false_holes(nothing, rgb), nothing)
    everything = np.ones_like(true)
    assert np.array_equal(without_false_holes(everything, rgb), everything)
