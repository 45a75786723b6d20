"""The ground's light is what photos agree on beside the object."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import orbit

from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.color import linear_from_srgb, srgb_from_linear
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.radiance import CELLS, REACH, Exposed, ground_radiance

BALL = Ball(np.array([0.0, 0, 0.5]), 0.5)
PLANE = (np.array([0.0, 0, 1]), 0.0)
GROUND = Ground.under(BALL, *PLANE, REACH * BALL.radius)


def board() -> np.ndarray:
    """(CELLS, CELLS, 3) linear radiance."""
    y, x = np.mgrid[0:CELLS, 0:CELLS] / CELLS
    waves = 0.3 + 0.15 * np.sin(9 * x) * np.cos(7 * y)
    return np.dstack([waves, 0.6 * waves, 0.3 * waves]).astype(np.float32)


def photos(count: int = 8) -> list[Exposed]:
    """Photos of the board with a black ball on it, each with an exposure of its own."""
    found = []
    for i, camera in enumerate(orbit(count)):
        linear = GROUND.drawn(board(), camera)
        valid = np.isfinite(linear[..., 0])
        toward = camera.pixel_rays() @ camera.cam_from_world[:3, :3]
        toward = toward / np.linalg.norm(toward, axis=-1, keepdims=True)
        off = np.asarray(camera.center) - BALL.center
        along = toward @ off
        ball = along**2 - off @ off + BALL.radius**2 > 0
        darker = 0.7 + 0.05 * i
        linear = np.where(ball[..., None], 0, np.nan_to_num(linear) * darker)
        rgb = srgb_from_linear(linear.astype(np.float32))
        found.append(Exposed(Photo(camera, rgb, ball.astype(np.float32), valid), 1 / darker))
    return found


def test_the_boards_light_is_found_beside_the_object() -> None:
    found = ground_radiance(photos(), BALL, PLANE)
    assert found is not None
    known = found.picture[..., 3] > 0.9
    assert known.mean() > 0.2
    color = found.picture[..., :3][known]
    assert np.abs(color - board()[known]).mean() < 0.01
    assert color.min() > 0.02  # the ball is black


def test_what_the_object_hides_is_filled_from_around_it() -> None:
    found = ground_radiance(photos(), BALL, PLANE)
    assert found is not None
    middle = CELLS // 2
    color, share = found.picture[middle, middle, :3], found.picture[middle, middle, 3]
    assert share == pytest.approx(1)
    assert np.abs(color / board()[middle, middle] - 1).max() < 0.15
    assert found.picture[0, 0, 3] == 0  # beyond what photos show nothing is filled


def test_what_photos_do_not_agree_on_is_not_told() -> None:
    one = photos()
    broken = []
    for i, shown in enumerate(one):
        linear = linear_from_srgb(shown.photo.rgb) * (0.25 * 1.3**i)
        rgb = srgb_from_linear(np.clip(linear, 0, 1).astype(np.float32))
        broken.append(replace(shown, photo=replace(shown.photo, rgb=rgb)))
    found = ground_radiance(broken, BALL, PLANE)
    assert found is None or (found.picture[..., 3] > 0.9).mean() < 0.05


def test_few_photos_or_none_with_a_mask_tell_nothing() -> None:
    some = photos()
    assert ground_radiance(some[:2], BALL, PLANE) is None
    bare = [replace(one, photo=replace(one.photo, mask=None)) for one in some]
    assert ground_radiance(bare, BALL, PLANE) is None
