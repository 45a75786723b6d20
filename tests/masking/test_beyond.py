"""What photos show of a room beside the plane."""

from typing import Any

import numpy as np
import pytest

from refdgs_pipe.ground.shots import F32, Bools, Shot
from refdgs_pipe.masking.beyond import EDGES, OUTLINE, _set_apart, is_plain

ROWS, COLUMNS = np.mgrid[:80, :120]
LEFT, RIGHT = np.hypot(ROWS - 40, COLUMNS - 40), np.hypot(ROWS - 40, COLUMNS - 80)
BESIDE = (np.minimum(LEFT, RIGHT) > 22).astype(bool)
TINT = np.array([0.045, 0.045, 0.05], np.float32)


def plain_room(edge: float, slope: float = 0.0) -> F32:
    """A room of one colour with two discs: a mirror at the left, and a ring at the right."""
    rng = np.random.default_rng(0)
    logs = np.full((*ROWS.shape, 3), -1.0, np.float32) + slope * COLUMNS[..., None]
    logs -= (LEFT < 15)[..., None] * TINT
    logs += edge * ((np.abs(LEFT - 15) < 1.5) | (np.abs(RIGHT - 15) < 1.5))[..., None]
    return np.asarray(logs + rng.normal(0, 0.004, logs.shape), np.float32)


def inside(found: Bools) -> tuple[float, float]:
    """The shares of both discs, within their edges, that are set apart."""
    return float(found[LEFT < 9].mean()), float(found[RIGHT < 9].mean())


@pytest.mark.parametrize("slope", [0.0, 0.0005])
def test_a_mirror_of_a_plain_room_is_set_apart_and_a_hole_is_not(slope: float) -> None:
    found = _set_apart(plain_room(0.3, slope), BESIDE)
    assert inside(found) == (1.0, 0.0)
    assert not found[(LEFT > 20 + EDGES) & (RIGHT > 20) | (RIGHT < 9)].any()


def test_what_no_edge_separates_counts_as_room() -> None:
    gap = plain_room(0.3)
    gap[34:46, 40:62] = -1.0  # the mirror's edge is open at one side
    assert not _set_apart(gap, BESIDE)[LEFT < 8].any()
    assert not _set_apart(plain_room(0.3), np.zeros_like(BESIDE)).any()  # no room to compare with


def test_what_has_texture_is_set_apart_from_a_plain_room_only() -> None:
    textured = plain_room(0.3)
    textured[LEFT < 15] += 0.2 * ((ROWS + COLUMNS) % 4 < 2)[LEFT < 15][:, None]
    assert _set_apart(textured, BESIDE)[LEFT < 12].all()
    textured += 0.2 * ((ROWS + 2 * COLUMNS) % 6 < 3)[..., None]
    assert not _set_apart(textured, BESIDE).any()


def test_something_thin_is_set_apart_from_a_plain_room() -> None:
    logs = plain_room(0.0)
    bar = np.abs(COLUMNS - 60) < 1.5
    logs[bar] += 0.2
    found = _set_apart(logs, BESIDE | (np.abs(COLUMNS - 60) > 8))
    assert found[bar][6:-6].all()
    assert not found[np.abs(COLUMNS - 60) > 4 + OUTLINE].any()


def photos_of_rooms(kinds: str) -> list[Shot]:
    """One photo for each letter: a `p`lain room, or one with texture."""
    rng = np.random.default_rng(1)
    camera: Any = None
    whole = (COLUMNS.shape[1], COLUMNS.shape[0])
    shots = []
    for kind in kinds:
        rgb = np.full((*ROWS.shape, 3), 0.5, np.float32)
        if kind != "p":
            rgb *= rng.uniform(0.8, 1.2, (*ROWS.shape, 1)).astype(np.float32)
        box = (0, whole[0], 0, whole[1])
        shots.append(Shot(camera, rgb, np.ones(ROWS.shape, bool), box, whole))
    return shots


@pytest.mark.parametrize(("kinds", "plain"), [("ppp", True), ("ppt", True), ("ptt", False)])
def test_a_room_is_plain_if_most_photos_show_no_texture(kinds: str, plain: bool) -> None:
    assert is_plain(photos_of_rooms(kinds), [BESIDE] * len(kinds)) == plain
    assert not is_plain(photos_of_rooms(kinds), [np.zeros_like(BESIDE)] * len(kinds))
