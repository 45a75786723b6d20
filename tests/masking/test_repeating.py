"""Grounds that repeat in two directions are known; stripes, grain and print are not."""

import numpy as np

from refdgs_pipe.masking.repeating import repeats

N = 192
Y, X = np.mgrid[0:N, 0:N]
SEEN = np.ones((N, N), np.float32)


def noise(amount: float) -> np.ndarray:
    return amount * np.random.default_rng(0).normal(size=(N, N))


def test_checks_repeat_also_turned_and_noisy() -> None:
    u, v = 0.9 * X + 0.4 * Y, 0.9 * Y - 0.4 * X
    checks = ((u // 14) % 2 + (v // 14) % 2).astype(float)
    assert repeats((checks + noise(0.2)).astype(np.float32), SEEN)


def test_checks_are_known_where_a_part_is_seen() -> None:
    checks = ((X // 12) % 2 + (Y // 12) % 2).astype(np.float32)
    part = np.where(np.hypot(X - 96, Y - 96) > 40, checks, np.float32(np.nan))
    assert repeats(part, SEEN)


def test_stripes_repeat_in_one_direction_only() -> None:
    stripes = ((X // 10) % 2 + noise(0.3)).astype(np.float32)
    assert not repeats(stripes, SEEN)


def test_grain_does_not_repeat() -> None:
    assert not repeats(noise(1.0).astype(np.float32), SEEN)


def test_an_unknown_ground_does_not_repeat() -> None:
    assert not repeats(np.full((N, N), np.nan, np.float32), 0 * SEEN)
