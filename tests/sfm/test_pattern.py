"""Photos placed by what tells the repeats of a ground apart."""

import cv2
import numpy as np
import pytest

from refdgs_pipe.camera import F64
from refdgs_pipe.sfm.pattern.graph import laid_out
from refdgs_pipe.sfm.pattern.lattice import find_lattice, mapped
from refdgs_pipe.sfm.pattern.pairs import Overlay, overlay, spectra, turn
from refdgs_pipe.sfm.pattern.topview import refined, residual, settled

PERIOD = 40  # pixels of the cloth
K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
TURNS = (0, 1, 2, 3)


def cloth() -> np.ndarray:
    """Checks of three tones with stains that do not repeat."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:1200, :1200] // (PERIOD // 2)
    checks = 60.0 + 70 * (x % 2) + 70 * (y % 2)
    stains = cv2.GaussianBlur(rng.normal(0, 1, checks.shape), (0, 0), 3)
    return np.clip(checks + 12 * stains / stains.std(), 0, 255).astype(np.uint8)


def look(azimuth: float, elevation: float) -> F64:
    """(3, 3) from the cloth's pixels to those of a photo that looks at its middle."""
    a, e = np.radians(azimuth), np.radians(elevation)
    away = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    forward = -away
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    plane = np.array([[1 / 150, 0, -4.0], [0, -1 / 150, 4.0], [0, 0, 0], [0, 0, 1]])
    return np.asarray(K @ np.c_[R, R @ (-away * 4)] @ plane)


def photo(homography: F64) -> np.ndarray:
    return np.asarray(cv2.warpPerspective(cloth(), homography, (640, 480), flags=cv2.INTER_AREA))


def test_the_lattice_of_a_slanted_cloth_is_found_with_its_period() -> None:
    homography = look(20, 35)
    grey = photo(homography)
    found = find_lattice(grey)
    assert found is not None
    found = refined(settled(found, grey, np.linalg.inv(K)), grey, 12)
    on_cloth = mapped(np.linalg.inv(homography) @ found.pixels_from_cells, found.nodes)
    steps = mapped(np.linalg.inv(homography) @ found.pixels_from_cells, found.nodes + np.eye(2)[0])
    assert np.linalg.norm(steps - on_cloth, axis=1) == pytest.approx(PERIOD, abs=0.5)


def test_noise_has_no_lattice() -> None:
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 1, (240, 320)), (0, 0), 3)
    assert find_lattice(np.clip(128 + 200 * noise, 0, 255).astype(np.uint8)) is None


def test_stains_tell_which_checks_are_the_same() -> None:
    views, ways = [], []
    for azimuth in (0, 65):
        homography = look(azimuth, 50)
        grey = photo(homography)
        found = find_lattice(grey)
        assert found is not None
        found = refined(settled(found, grey, np.linalg.inv(K)), grey, 14)
        views.append(spectra(residual(found, grey, 14), TURNS, 1))
        ways.append((found, np.linalg.inv(homography) @ found.pixels_from_cells))
    best = overlay(views[0], views[1], 14, 1)
    assert best is not None and best.ratio > 1.3
    nodes = ways[1][0].nodes
    said = mapped(ways[0][1], nodes @ turn(best.turns).T + best.shift)
    assert np.abs(said - mapped(ways[1][1], nodes)).max() < 0.2 * PERIOD


def chain(count: int) -> dict[tuple[int, int], Overlay]:
    """Photos that lie one cell from each other; all pairs say so."""
    pairs = ((a, b) for a in range(count) for b in range(a + 1, count))
    return {(a, b): Overlay(0, np.array([float(b - a), 0]), 20.0, 2.0) for a, b in pairs}


def test_a_pair_that_is_one_period_off_moves_no_photo() -> None:
    pairs = chain(7) | {(0, 6): Overlay(0, np.array([7.0, 0]), 90.0, 5.0)}
    laid = laid_out(7, pairs)
    assert laid[6].shift - laid[0].shift == pytest.approx([6.0, 0.0], abs=1e-9)


def test_a_photo_that_its_pairs_put_in_several_places_is_left_out() -> None:
    pairs = chain(7)
    for a in range(6):
        pairs[a, 6] = Overlay(a % 2, np.array([3.0 * a, a]), 20.0, 2.0)
    assert sorted(laid_out(7, pairs)) == [0, 1, 2, 3, 4, 5]


def test_photos_that_no_third_one_confirms_are_left_out() -> None:
    assert laid_out(2, chain(2)) == {}
