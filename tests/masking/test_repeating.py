"""Grounds that repeat in two directions are known, and what stands on them."""

import numpy as np

from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.masking.foot import Foot
from refdgs_pipe.masking.repeating import covered, lattice

N = 192
Y, X = np.mgrid[0:N, 0:N]
SEEN = np.ones((N, N), np.float32)


def noise(amount: float) -> np.ndarray:
    return amount * np.random.default_rng(0).normal(size=(N, N))


def test_checks_repeat_also_turned_and_noisy() -> None:
    u, v = 0.9 * X + 0.4 * Y, 0.9 * Y - 0.4 * X
    checks = ((u // 14) % 2 + (v // 14) % 2).astype(float)
    assert lattice((checks + noise(0.2)).astype(np.float32), SEEN) is not None


def test_checks_are_known_where_a_part_is_seen() -> None:
    checks = ((X // 12) % 2 + (Y // 12) % 2).astype(np.float32)
    part = np.where(np.hypot(X - 96, Y - 96) > 40, checks, np.float32(np.nan))
    assert lattice(part, SEEN) is not None


def test_stripes_repeat_in_one_direction_only() -> None:
    stripes = ((X // 10) % 2 + noise(0.3)).astype(np.float32)
    assert lattice(stripes, SEEN) is None


def test_grain_does_not_repeat() -> None:
    assert lattice(noise(1.0).astype(np.float32), SEEN) is None


def test_an_unknown_ground_does_not_repeat() -> None:
    assert lattice(np.full((N, N), np.nan, np.float32), 0 * SEEN) is None


def checked(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(N, N, 3) log colour of checks of 14.3 cells."""
    both = (u // 14.3) % 2 + (v // 14.3) % 2
    return np.stack([-0.9 * both, -0.6 * both, -0.2 * both], -1).astype(np.float32)


def test_shifts_of_the_pattern_are_measured_to_a_fraction_of_a_cell() -> None:
    found = lattice(checked(X, Y).mean(-1), SEEN)
    assert found is not None
    for shift in (found.one, found.other):
        assert np.allclose(shift / 28.6, np.rint(shift / 28.6), atol=0.006)


def standing(where: np.ndarray, shown: np.ndarray, agree: float = 0.35) -> np.ndarray:
    """What is found on checked cloth whose photos agree on `shown` at a place."""
    cloth = checked(X, Y)
    colour = np.where(where[..., None], shown, cloth).astype(np.float32)
    pattern = lattice(cloth.mean(-1), SEEN)
    assert pattern is not None
    near = np.hypot(X - 96, Y - 96) < 60
    agreeing = np.where(where, agree, np.where(near, 0.55, 0.9)).astype(np.float32)
    return covered(colour, agreeing, pattern)


BOX = (abs(X - 96) < 34) & (abs(Y - 90) < 22)


def lies_in_the_box(found: np.ndarray) -> bool:
    """The box is found but for an edge of most of a square, and next to nothing beside it."""
    inner = (abs(X - 96) < 34 - 11) & (abs(Y - 90) < 22 - 11)
    return bool((found & inner).sum() > 0.85 * inner.sum() and not (found & ~BOX).any())


def test_rough_metal_that_shows_the_mean_of_the_cloth_stands_on_it() -> None:
    found = standing(BOX, np.broadcast_to(checked(X, Y).mean((0, 1)), (N, N, 3)))
    assert lies_in_the_box(found)


def test_a_sharp_mirror_that_shows_the_cloth_in_another_place_stands_on_it() -> None:
    found = standing(BOX, checked(Y + 6.0, X + 5.0))
    assert lies_in_the_box(found)


def test_a_shadow_on_the_cloth_is_not_taken_for_an_object() -> None:
    shadow = -0.7 * np.exp(-(((X - 96) / 45) ** 2) - ((Y - 90) / 45) ** 2)
    found = standing(np.hypot(X - 96, Y - 96) < 90, checked(X, Y) + shadow[..., None], 0.55)
    assert not found.any()


def test_what_lies_beyond_the_cloths_edge_is_not_taken_for_an_object() -> None:
    found = standing(X > 150, np.full((N, N, 3), -1.7))
    assert not found.any()


def test_an_object_is_found_on_a_cloth_that_the_floor_surrounds() -> None:
    floor = np.maximum(abs(X - 96), abs(Y - 96)) > 84
    shown = np.where(floor[..., None], -1.7, checked(X, Y).mean((0, 1)))
    found = standing(BOX | floor, shown)
    assert lies_in_the_box(found)


def test_what_is_covered_has_the_same_place_in_a_picture_of_another_size() -> None:
    foot = Foot([], BOX, radius=2.0)
    ground = Ground(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), radius=1.0)
    y, x = (np.mgrid[0:100, 0:100] + 0.5) / 100 * 2 - 1
    expected = (x > -0.6875) & (x < 0.708) & (y > -0.5625) & (y < 0.333)
    assert (foot.on(ground, 100) != expected).mean() < 0.02
