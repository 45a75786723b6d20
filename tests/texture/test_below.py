"""The ground's light is looked for where the light stands still and photos show the ground."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scenes import Scene, Sphere, constant, gradient_sky, orbit

from refdgs_pipe.artifacts.lighting import WORLD, Lighting
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import linear_from_srgb, srgb_from_linear
from refdgs_pipe.ground_light import GroundLight
from refdgs_pipe.texture import below

BALL = Sphere((0, 0, 0.5), 0.5, constant(0.6, 0.4, 0.3), specular=(0.04, 0.04, 0.04))
SCENE = Scene((BALL,), gradient_sky)
PLANE = (np.array([0.0, 0, 1]), 0.0)
TABLE = np.array([0.2, 0.3, 0.1])


def shown(camera: Camera) -> SurfaceMap:
    return SCENE.surface_map(camera)


def photo_of(_: Any, __: Any, camera: Camera, scale: float = 1.0) -> Photo:
    """The ball on a plain table, exposed at three quarters."""
    view = shown(camera)
    mask = (view.alpha > 0.5).astype(np.float32)
    linear = np.where(mask[..., None] > 0, linear_from_srgb(view.color), TABLE)
    rgb = srgb_from_linear((0.75 * linear).astype(np.float32))
    return Photo(camera, rgb, mask, np.ones(mask.shape, bool))


def looked_for(
    plane: Any = PLANE, lighting: Lighting = WORLD, background: str = "masked"
) -> GroundLight | None:
    cameras = orbit(8)
    model: Any = SimpleNamespace(training_cameras=cameras, ball=Ball(np.array([0, 0, 0.5]), 0.5))
    views: Any = SimpleNamespace(background=background)
    return below.light_below(shown, views, model, plane, lighting, lambda cameras, _: cameras)


def test_the_tables_light_is_as_bright_as_the_field(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(below, "load_photo", photo_of)
    found = looked_for()
    assert found is not None
    known = found.picture[..., 3] > 0.9
    assert np.abs(found.picture[..., :3][known] - TABLE).max() < 0.02


@pytest.mark.parametrize(
    "asked",
    [
        {"plane": None},
        {"background": "removed"},
        {"lighting": replace(WORLD, kind="flash")},
        {"lighting": replace(WORLD, kind="turntable")},
    ],
)
def test_it_is_not_looked_for_without_a_plane_or_in_light_that_moves(asked: dict[str, Any]) -> None:
    assert looked_for(**asked) is None
