"""A glossy ground is told from a matte one by what it mirrors."""

import cv2
import numpy as np
import pytest
from captures import looking
from printed_ground import BALL, GROUND, PLANE, blots

from refdgs_pipe.camera import Camera
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.ground.shots import Shot
from refdgs_pipe.masking import gloss
from refdgs_pipe.masking.gloss import is_glossy
from refdgs_pipe.mirrored import Room

SIZE = (160, 120)
UP = PLANE[0]


def shots_of(gloss: float, walls: float | None = None, turned: float = 0.0) -> list[Shot]:
    """Photos of a print in two rings, with stripes of a room mirrored in it, and a dark ball.

    Args:
        gloss: how much of the room's light the print mirrors.
        walls: how far away the room is; None: infinitely.
        turned: by how much the room turns from photo to photo, radians.
    """
    printed, out = 0.4 * blots().astype(np.float32), []
    for i in range(24):
        around, up = np.radians(15 * i), np.radians((20, 45)[i % 2])
        eye = 3.4 * np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
        K = np.array([[160.0, 0, SIZE[0] / 2], [0, 160.0, SIZE[1] / 2], [0, 0, 1]])
        camera = Camera(f"{i}", *SIZE, K, looking(eye, (0.0, 0.0, 0.4)))
        linear = GROUND.drawn(printed, camera, 0.1)
        rays = camera.pixel_rays().reshape(-1, 3) @ camera.cam_from_world[:3, :3]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        places = eye - rays * (eye[2] / np.minimum(rays[:, 2:], -1e-3))
        away = rays * [1, 1, -1]
        away = away if walls is None else Room(BALL.center, walls).met(places, away)
        bearing = np.arctan2(away[:, 1], away[:, 0]) + turned * i
        room = 0.5 + 0.5 * np.sign(np.sin(5 * bearing) * np.sin(9 * away[:, 2]))
        linear = linear + gloss * (room * (rays[:, 2] < 0)).reshape(SIZE[1], SIZE[0], 1)
        at, depth = camera.project(np.array([[0.0, 0, 0.3]]))
        radius = round(0.3 * K[0, 0] / depth[0])
        color = srgb_from_linear(np.ascontiguousarray(linear.clip(0, 1), np.float32))
        cv2.circle(color, at[0].round().astype(int).tolist(), radius, (0.1, 0.1, 0.1), -1)
        valid = np.ones(color.shape[:2], bool)
        out.append(Shot(camera, color, valid, (0, SIZE[0], 0, SIZE[1]), SIZE))
    return out


def found(shots: list[Shot], threads: int = 1) -> bool:
    return is_glossy(shots, BALL, PLANE, 2.2, threads)


@pytest.mark.parametrize("walls", [None, 8.0])
def test_a_ground_that_mirrors_a_room_is_glossy(walls: float | None) -> None:
    assert found(shots_of(0.25, walls))
    assert found(shots_of(0.25, walls), threads=2)


def test_a_matte_ground_is_not() -> None:
    assert not found(shots_of(0.0))


def test_light_that_moves_is_no_gloss() -> None:
    assert not found(shots_of(0.25, turned=1.7))


def test_places_in_the_room_are_of_equal_area() -> None:
    rng = np.random.default_rng(5)
    unit = rng.normal(size=(200_000, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit[:, 2] = np.abs(unit[:, 2])
    x, y = gloss._place(unit).T
    counts, _, _ = np.histogram2d(x, y, bins=8, range=[[0, gloss.BINS]] * 2)
    inner = counts[2:6, 2:6]
    assert inner.std() < 0.03 * inner.mean()
