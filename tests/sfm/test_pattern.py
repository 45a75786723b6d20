"""Photos placed by what tells the repeats of a ground apart."""

import cv2
import numpy as np
import pytest
from scenes import look_at

from refdgs_pipe.camera import F64
from refdgs_pipe.sfm.pattern.beside import Beside, agreeing, matches
from refdgs_pipe.sfm.pattern.cells import SharedCell, shared_cell, turn
from refdgs_pipe.sfm.pattern.graph import laid_out
from refdgs_pipe.sfm.pattern.lattice import find_lattice, mapped
from refdgs_pipe.sfm.pattern.pairs import REACH, SHIFTS, Evidence, evidence, prepared
from refdgs_pipe.sfm.pattern.topview import refined, residual, settled

PERIOD = 40  # pixels of the cloth
CELL = 14  # pixels of a cell from above
K = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
NOTHING = Beside(np.zeros((0, 3)), np.zeros((0, 128), np.float32), np.eye(4), 0.0)


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


Shared = tuple[SharedCell, list[np.ndarray], list[F64]]


@pytest.fixture(scope="module")
def shared() -> Shared:
    """What photos from three sides show, the photos, and (3, 3) cloth from photo of each."""
    ways = [look(azimuth, 50) for azimuth in (0, 65, 200)]
    greys = [photo(way) for way in ways]
    lattices = []
    for grey in greys:
        found = find_lattice(grey)
        assert found is not None
        lattices.append(refined(settled(found, grey, np.linalg.inv(K)), grey, CELL))
    cell = shared_cell(lattices, greys, np.linalg.inv(K), CELL)
    assert cell is not None and sorted(cell.lattices) == [0, 1, 2]
    return cell, greys, [np.linalg.inv(way) for way in ways]


def on_cloth(cell: SharedCell, k: int, way: F64, cells: F64) -> F64:
    """(n, 2) periods of the cloth where cells (n, 2) of a photo lie."""
    return mapped(way @ cell.lattices[k].pixels_from_cells, cells) / PERIOD


def test_whole_cells_are_the_same_place_of_the_pattern_in_all_photos(shared: Shared) -> None:
    cell, _, ways = shared
    assert sorted(cell.offsets) == [0, 1, 2, 3]
    starts = []
    for k, way in enumerate(ways):
        there = on_cloth(cell, k, way, np.round(cell.lattices[k].nodes))
        start = np.exp(2j * np.pi * there).mean(0)  # as an angle, for periods have no end
        assert np.abs(start).min() > 0.98
        starts.append(np.angle(start) / (2 * np.pi))
    # the checks are the same after a quarter turn about two places: all start at one of these
    steps = {tuple(np.round(2 * (start - starts[0])).astype(int) % 2) for start in starts}
    assert steps <= {(0, 0), (1, 1)}


def test_cells_of_half_a_period_are_made_whole(shared: Shared) -> None:
    cell, greys, ways = shared
    halved = cell.lattices[2].in_basis(np.array([[0.5, 0], [0, 1]]))
    again = shared_cell([cell.lattices[0], cell.lattices[1], halved], greys, np.linalg.inv(K), CELL)
    assert again is not None
    a, b = mapped(ways[2] @ again.lattices[2].pixels_from_cells, np.array([[0.0, 0], [1, 0]]))
    assert np.linalg.norm(b - a) == pytest.approx(PERIOD, abs=0.5)


def test_stains_tell_which_checks_are_the_same(shared: Shared) -> None:
    cell, greys, ways = shared
    photos = []
    for k, grey in enumerate(greys[:2]):
        view = residual(cell.lattices[k], grey, cell.median)
        middle = np.median(cell.lattices[k].nodes, axis=0)
        photos.append(prepared(view, middle, NOTHING, tuple(cell.offsets), 1))
    said = evidence(photos[0], photos[1], cell.offsets, 1)
    turns = max(said.table, key=lambda k: said.table[k].max())
    row, column = np.unravel_index(int(said.table[turns].argmax()), (SHIFTS, SHIFTS))
    shift = said.start[turns] + np.array([column, row])
    nodes = cell.lattices[1].nodes
    found = on_cloth(cell, 0, ways[0], nodes @ turn(turns).T + shift)
    assert found == pytest.approx(on_cloth(cell, 1, ways[1], nodes), abs=0.1)
    values = np.sort(np.concatenate([table.ravel() for table in said.table.values()]))
    assert values[-1] > 2 * values[-2]


def test_what_does_not_look_like_the_ground_is_no_ground(shared: Shared) -> None:
    cell, greys, _ = shared
    grey = greys[0].copy()
    cv2.circle(grey, (320, 240), 60, 128, -1)
    view = residual(cell.lattices[0], grey, cell.median)
    inside = mapped(np.linalg.inv(cell.lattices[0].pixels_from_cells), np.array([[320.0, 240]]))[0]
    x, y = np.round((inside - view.origin) * CELL + (len(view.known) - 1) / 2).astype(int)
    assert not view.known[y - 10 : y + 10, x - 10 : x + 10].any()
    assert view.known.sum() > 5000


def test_features_beside_the_ground_fit_at_the_right_place_only() -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([-1, -1, 0.2], [1, 1, 1.5], (40, 3))
    looks = rng.normal(0, 1, (40, 128)).astype(np.float32)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)

    def seen(azimuth: float, world_from_cells: F64) -> Beside:
        a = np.radians(azimuth)
        pose = look_at("a", np.array([3 * np.cos(a), 3 * np.sin(a), 2.0])).cam_from_world
        rays = points @ pose[:3, :3].T + pose[:3, 3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return Beside(rays, looks, pose @ world_from_cells, 1.5 / 600)

    moved = np.eye(4)  # the second photo counts its cells a quarter turn and (2, -1) from the first
    moved[:2, :2] = np.diag([1, -1]) @ turn(1) @ np.diag([1, -1])
    moved[:2, 3] = 2.0, 1.0
    one, other = seen(0, np.eye(4)), seen(40, moved)
    matched = matches(one, other)
    assert matched is not None and len(matched[0]) == 40
    shifts = np.array([[2.0, -1], [3, -1], [2, 0], [1, -2]])
    right = agreeing(one, other, matched, 1, shifts)
    assert right[0] == 40 and right[1:].max() < 15
    assert agreeing(one, other, matched, 0, shifts).max() < 15
    assert matches(one, Beside(one.rays[:5], one.looks[:5], one.cam_from_cells, one.off)) is None


PLACES = np.stack([np.arange(8) % 4, np.arange(8) // 4], 1) * 2.0
OFFSETS = {0: np.zeros(2), 2: np.array([0.4, 0.2])}


def said(shift: F64, strength: float, seed: int, turns: int = 0) -> Evidence:
    """What speaks for places of a pair: one, and chance."""
    rng = np.random.default_rng(seed)
    start = {k: offset - REACH for k, offset in OFFSETS.items()}
    table = {k: np.abs(rng.normal(0, 1, (SHIFTS, SHIFTS))).astype(np.float32) for k in OFFSETS}
    column, row = np.round(shift - start[turns]).astype(int)
    table[turns][row, column] = strength
    return Evidence(start, table)


def pairs_of(places: F64, strength: float) -> dict[tuple[int, int], Evidence]:
    """Photos that lie at these cells; each pair says so."""
    count = len(places)
    pairs = ((a, b) for a in range(count) for b in range(a + 1, count))
    return {(a, b): said(places[b] - places[a], strength, 100 * a + b) for a, b in pairs}


def test_pairs_that_are_one_period_off_move_no_photo() -> None:
    pairs = pairs_of(PLACES, 9.0)
    pairs[0, 7] = said(PLACES[7] - PLACES[0] + [1, 0], 20.0, 1)
    pairs[1, 7] = said(PLACES[7] - PLACES[1] + [0, 1], 20.0, 2, turns=2)
    laid = laid_out(np.zeros((8, 2)), pairs, OFFSETS)
    assert sorted(laid) == list(range(8))
    for k, place in laid.items():
        back = turn(laid[0].turns).T @ (place.shift - laid[0].shift)
        assert place.turns == laid[0].turns and back == pytest.approx(PLACES[k] - PLACES[0])


def test_weak_pairs_decide_together() -> None:
    """No pair alone is far above chance."""
    laid = laid_out(np.zeros((8, 2)), pairs_of(PLACES, 5.0), OFFSETS)
    assert [laid[k].shift - laid[0].shift for k in range(8)] == pytest.approx(PLACES - PLACES[0])


def test_a_photo_that_its_pairs_put_in_several_places_is_left_out() -> None:
    pairs = pairs_of(PLACES, 12.0)
    for a in range(7):
        pairs[a, 7] = said(np.array([3.0 * a, -a]), 12.0, a)
    assert sorted(laid_out(np.zeros((8, 2)), pairs, OFFSETS)) == list(range(7))


def test_a_group_that_hangs_on_one_pair_is_left_out() -> None:
    """Each photo of both groups is confirmed by its own group."""
    places = np.concatenate([PLACES, PLACES[:5] + np.array([9.0, 3])])
    pairs = pairs_of(places, 12.0)
    for a, b in pairs:
        if a < 8 <= b:
            pairs[a, b] = said(places[b] - places[a], 8.0 if (a, b) == (7, 8) else 1.0, a + b)
    assert sorted(laid_out(np.zeros((13, 2)), pairs, OFFSETS)) == list(range(8))


def test_photos_that_no_third_one_confirms_are_left_out() -> None:
    assert laid_out(np.zeros((3, 2)), pairs_of(PLACES[:3], 12.0), OFFSETS) == {}
    assert laid_out(np.zeros((0, 2)), {}, OFFSETS) == {}
