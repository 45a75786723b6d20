"""Flat mirrors on a printed plane are told by its mirror image, and nothing else is."""

import cv2
import numpy as np
import pytest

from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.masking import walls as walls_module
from refdgs_pipe.masking.table import Table
from refdgs_pipe.masking.walls import Wall, footprint, mirror_walls

CELLS, REACH, PHOTOS = 128, 2.2, 24
HALF = np.array([0.45, 0.3])  # of the box, along its own axes
TURN = np.radians(20)
AXES = np.array([[np.cos(TURN), np.sin(TURN)], [-np.sin(TURN), np.cos(TURN)]])


def places(cells: int = CELLS) -> np.ndarray:
    """(n, n, 2) of the plane's cells."""
    y, x = ((np.mgrid[0:cells, 0:cells] + 0.5) / cells * 2 - 1) * REACH
    return np.stack([x, y], -1)


def printed(at: np.ndarray, kind: str) -> np.ndarray:
    """Log brightness of a plane at (..., 2)."""
    if kind == "stripes":
        return np.asarray(0.3 * np.sign(np.sin(40 * at[..., 0])))
    if kind == "squares":
        return np.asarray(0.3 * np.sign(np.sin(25 * at[..., 0]) * np.sin(25 * at[..., 1])))
    if kind == "tiles":  # of many colours, turned as the box is: grout is its own mirror image
        own = at @ AXES.T / 0.2
        tone = np.random.default_rng(2).normal(0, 0.1, (40, 40))
        column, row = (np.floor(own).astype(int) + 20).clip(0, 39).transpose(2, 0, 1)
        return np.where((own % 1 < 0.25).any(-1), 0.5, tone[row, column])
    blots = np.random.default_rng(1).normal(0, 0.3, (160, 160)).astype(np.float32)
    index = ((at / REACH / 2 + 0.5) * 160).astype(np.float32)
    return cv2.remap(blots, index[..., 0], index[..., 1], cv2.INTER_CUBIC)


def table(cells: int = CELLS) -> Table:
    axes = np.eye(3)
    return Table(Ground(np.zeros(3), axes[0], axes[1], REACH), cells, PHOTOS)


def capture(mirror: bool, kind: str = "blots", cells: int = CELLS) -> tuple[np.ndarray, np.ndarray]:
    """(N, n, n, 3) the plane as photos show it, and (N, 3) cameras round a box on it.

    What lies behind the box's walls is hidden, or shows their mirror image.
    """
    at = places(cells)
    truth = printed(at, kind)
    own = at @ AXES.T
    inside = (np.abs(own) < HALF).all(-1)
    seen, centers = [], []
    for i in range(PHOTOS):
        angle = 2 * np.pi * (i + 0.3) / PHOTOS
        towards = np.array([np.cos(angle), np.sin(angle)])
        facing = AXES @ towards
        behind = np.zeros(inside.shape, bool)  # of the box, as seen from here
        for step in np.linspace(0, 0.5, 40):
            behind |= (np.abs((at + step * towards) @ AXES.T) < HALF).all(-1)
        picture = np.where(behind & ~inside, np.random.default_rng(i).normal(), truth)
        axis = int(np.argmax(np.abs(facing) / HALF[::-1]))
        flipped = own.copy()
        flipped[..., axis] = 2 * np.sign(facing[axis]) * HALF[axis] - own[..., axis]
        image = printed(flipped @ AXES, kind) - 0.2
        shown = image if mirror else np.random.default_rng(i).normal(0, 0.3, truth.shape)
        picture = np.where(inside, shown, picture)
        seen.append(np.repeat(picture[..., None], 3, -1))
        centers.append([*(3 * towards), 1.5])
    return np.stack(seen).astype(np.float32), np.array(centers)


def test_the_four_walls_of_a_mirror_box_are_found() -> None:
    seen, centers = capture(mirror=True)
    walls = mirror_walls(table(), seen, centers, 1.0)
    sides = set()
    for wall in walls:
        own = AXES @ wall.outward
        axis = int(np.abs(own).argmax())
        assert abs(own[axis]) > np.cos(np.radians(4))
        place = (AXES @ wall.middle)[axis] * np.sign(own[axis])
        assert place == pytest.approx(HALF[axis], abs=0.03)
        sides.add((axis, bool(own[axis] > 0)))
    assert len(sides) == 4
    covered = footprint(walls, table().ground, CELLS)
    inside = (np.abs(places() @ AXES.T) < HALF).all(-1)
    assert (covered & inside).sum() > 0.7 * inside.sum()
    assert (covered & ~inside).sum() < 0.08 * inside.sum()


@pytest.mark.parametrize(
    ("kind", "cells"),
    [
        ("blots", CELLS),
        ("stripes", CELLS),
        ("squares", CELLS),
        pytest.param("tiles", 256, marks=pytest.mark.slow),  # grout is narrow
    ],
)
def test_an_object_that_mirrors_nothing_has_no_walls(kind: str, cells: int) -> None:
    seen, centers = capture(mirror=False, kind=kind, cells=cells)
    assert mirror_walls(table(cells), seen, centers, 1.0) == []


def test_a_mirror_image_is_like_in_most_of_its_parts() -> None:
    rng = np.random.default_rng(0)
    one, other = rng.normal(0, 1, (2, 12, 60)).astype(np.float32)
    assert walls_module._evenly(one, one) > 0.95
    crossing = other.copy()
    crossing[:, :10] = 20 * one[:, :10]  # most of the likeness lies in one place
    assert float((one * crossing).sum()) > 0.6 * np.linalg.norm(one[:, :10]) * np.linalg.norm(
        crossing
    )
    assert walls_module._evenly(one, crossing) < 0.3


def test_photos_from_too_few_places_tell_of_no_walls() -> None:
    seen, centers = capture(mirror=True)
    assert mirror_walls(table(), seen[::12], centers[::12], 1.0) == []


def test_what_stands_before_another_wall_is_not_covered() -> None:
    def wall(x: float, outward: float) -> Wall:
        return Wall(np.array([x, 0.0]), np.array([outward, 0.0]), (-0.5, 0.5), 0.6, 0.9, 0.9, 0.9)

    covered = footprint([wall(0.2, 1), wall(-0.2, -1)], table().ground, CELLS)
    x = places()[..., 0]
    assert covered.any()
    assert np.abs(x[covered]).max() < 0.21


@pytest.mark.parametrize(
    "likenesses, even, kept",
    [
        ({0: 0.65}, 0.9, []),  # a patch of print can look like the mirror image of another
        ({0: 0.8}, 0.9, [0]),
        ({0: 0.65, 90: 0.65}, 0.9, [0, 90]),
        ({0: 0.8, 90: 0.8}, 0.2, []),  # all of the likeness lies in one place
        ({0: 0.65, 45: 0.65}, 0.9, []),
        ({0: 0.65, 180: 0.65, 90: 0.45, 30: 0.45}, 0.9, [0, 90, 180]),
        ({0: 0.55, 90: 0.65}, 0.9, []),
        ({0: 0.55, 90: 0.58, 180: 0.52}, 0.9, [0, 90, 180]),
    ],
)
def test_a_weak_likeness_counts_only_beside_another_mirror(
    likenesses: dict[int, float], even: float, kept: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    def lines(pictures: object, turn: float, *_: object) -> list[Wall]:
        if turn % 360 not in likenesses:
            return []
        outward = np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
        value = likenesses[int(turn % 360)]
        return [Wall(0.4 * outward, outward, (-0.2, 0.2), 0.2, value, value, even)]

    monkeypatch.setattr(walls_module, "_lines", lines)
    seen = np.zeros((PHOTOS, 32, 32, 3), np.float32)  # nothing looks at it
    turns = 2 * np.pi * np.arange(PHOTOS) / PHOTOS
    centers = np.stack([3 * np.cos(turns), 3 * np.sin(turns), np.ones(PHOTOS)], -1)
    found = mirror_walls(table(32), seen, centers, 1.0)
    degrees = [np.degrees(np.arctan2(w.outward[1], w.outward[0])) % 360 for w in found]
    assert sorted(round(d) for d in degrees) == kept
