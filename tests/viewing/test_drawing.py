"""The field as a viewer's camera sees it."""

import finished
import numpy as np
import pytest

from refdgs_pipe.training.render import render_surface_map
from refdgs_pipe.viewing.drawing import KINDS, camera_at, drawn, size_for

FIELD, CAMERA = finished.field(), finished.CAMERAS[1]


def test_a_viewers_camera_is_that_of_the_photo_it_stands_in() -> None:
    from scipy.spatial.transform import Rotation

    pose = CAMERA.world_from_cam
    wxyz = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    fov = 2 * np.arctan(CAMERA.height / 2 / CAMERA.K[1, 1])
    size = {"width": CAMERA.width, "height": CAMERA.height}
    made = camera_at(CAMERA.center, wxyz, fov=fov, **size)
    np.testing.assert_allclose(made.cam_from_world, CAMERA.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(made.K, CAMERA.K, atol=1e-9)


def test_the_photo_is_the_rendering_over_white() -> None:
    maps = render_surface_map(FIELD, CAMERA)
    expected = np.clip(maps.color + 1 - maps.alpha[..., None], 0, 1) * 255
    assert np.abs(drawn(FIELD, CAMERA, "photo").pixels - expected).max() <= 0.5


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_shows_something_and_white_where_nothing_is(kind: str) -> None:
    made = drawn(FIELD, CAMERA, kind)
    assert made.pixels.shape == (48, 48, 3)
    empty = render_surface_map(FIELD, CAMERA).alpha < 1e-4
    assert empty.any()
    assert (made.pixels[empty] >= 254).all()
    assert (made.pixels < 250).any()
    assert np.isinf(made.depth[empty]).all()


def test_the_size_keeps_the_shape_of_the_window() -> None:
    assert size_for(2.0, 400) == (400, 200)
    assert size_for(0.5, 400) == (200, 400)
    assert size_for(float("nan"), 100) == (100, 100)
