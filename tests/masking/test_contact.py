"""A body's walls go down to the ground, where photos took bites of its foot."""

import numpy as np
import pytest
from scenes import orbit

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.ground.shots import Bools, Shot, grown
from refdgs_pipe.masking.contact import upright
from refdgs_pipe.masking.solid import grid, silhouette

UP = np.array([0.0, 0.0, 1.0])
CELLS = grid(Ball(np.array([0.0, 0.0, 0.45]), 1.0), UP, 0.0, 64)
X, Y, HEIGHT = CELLS.points.T
SHOTS = [
    Shot(
        camera,
        np.zeros((160, 160, 3), np.float32),
        np.ones((160, 160), bool),
        (0, 160) * 2,
        (160,) * 2,
    )
    for camera in orbit(48)[:24]
]
SIDE = [i for i, shot in enumerate(SHOTS) if shot.camera.center[0] > 2]  # those that see +x


def asked(solid: Bools, bite: Bools, denying: list[int]) -> Bools:
    """(n ** 3,) the cells that come back where some photos take a bite for the ground."""
    whole = solid | bite
    free = [grown(silhouette(CELLS, whole, shot), 1) for shot in SHOTS]
    for i in denying:
        free[i] &= ~silhouette(CELLS, bite, SHOTS[i])
    known = [np.ones_like(one) for one in free]
    back = upright(CELLS, solid, SHOTS, free, known, (UP, 0.0))
    assert (back >= solid).all()
    return back & ~solid


def box(half: float, *, rounded: float = 0.0) -> Bools:
    """(n ** 3,) of an upright box; its lower edge recedes by `rounded` at the ground."""
    reach = half - np.maximum(rounded - HEIGHT, 0)
    near = (np.abs(X) < reach) & (np.abs(Y) < reach)
    return np.asarray(CELLS.inside & near & (HEIGHT < 0.6))


@pytest.mark.parametrize("rounded", [0.0, 0.05])
@pytest.mark.parametrize("photos", [3, 20])
def test_bites_below_upright_walls_come_back_unless_many_photos_deny_them(
    photos: int, rounded: float
) -> None:
    whole = box(0.4, rounded=rounded)
    bite = whole & (X > 0.25) & (HEIGHT < 0.12) & (np.abs(Y) < 0.2)
    back = asked(whole & ~bite, bite, (SIDE + list(range(24)))[:photos])
    if photos > 10:
        assert not back.any()
        return
    assert back[bite].mean() > 0.75
    assert (back & ~whole).sum() < 0.15 * bite.sum()


def test_what_recedes_all_round_and_what_stands_on_legs_stays_as_it_is() -> None:
    narrow = np.asarray(CELLS.inside & (np.hypot(X, Y) < 0.3 + 0.5 * HEIGHT) & (HEIGHT < 0.5))
    foot = narrow & (HEIGHT < 0.12)
    hanging = box(0.4) & (HEIGHT > 0.1)
    legs = CELLS.inside & (HEIGHT < 0.6) & (np.abs(np.abs(X) - 0.3) < 0.05) & (np.abs(Y) < 0.05)
    for solid in (narrow & ~foot | foot & (np.hypot(X, Y) < 0.15), hanging, legs):
        assert asked(solid, np.zeros_like(solid), []).sum() < 0.003 * solid.sum()
