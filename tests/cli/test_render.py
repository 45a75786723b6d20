"""Laws of rendering a trained model from the command line."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scenes import glossy_pair, orbit

from refdgs_pipe.cli import render
from refdgs_pipe.errors import InputError

CAMERAS = orbit(6, size=32, focal=45.0)


@pytest.fixture
def model() -> Any:
    ball = SimpleNamespace(center=np.zeros(3), radius=1.2)
    found = SimpleNamespace(cameras=CAMERAS, ball=ball, up=np.array([0.0, 0.0, 1.0]), poses={})
    found.placed = lambda poses, ball: found
    return found


@pytest.fixture
def space(model: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A workspace whose trained field is the procedural scene."""
    monkeypatch.setattr(render, "_load", lambda space, stage: model)
    monkeypatch.setattr(
        "refdgs_pipe.training.render.render_surface_map",
        lambda field, camera, **options: glossy_pair().surface_map(camera),
    )
    return None


def draw(space: Any, out: Path, **options: Any) -> int:
    chosen = {"split": "train", "orbit": 0, "scale": 1.0, "device": "cpu", "threads": 1} | options
    return render.render_views(space, out, **chosen)


def test_each_view_is_a_picture_over_white_and_its_maps(space: Any, tmp_path: Path) -> None:
    assert draw(space, tmp_path / "views") == len(CAMERAS)
    truth = glossy_pair().surface_map(CAMERAS[0])
    with np.load(tmp_path / "views" / "v000.npz") as maps:
        assert set(maps.files) == set(render.MAPS)
        assert np.array_equal(maps["depth"], truth.depth)
    picture = np.asarray(Image.open(tmp_path / "views" / "v000.png"))
    assert (picture[truth.alpha == 0] == 255).all()
    inside = truth.alpha == 1
    assert np.abs(picture[inside] / 255 - truth.color[inside]).max() <= 0.5 / 255 + 1e-6


def test_a_smaller_scale_gives_smaller_pictures(space: Any, tmp_path: Path) -> None:
    draw(space, tmp_path, scale=0.5)
    assert Image.open(tmp_path / "v000.png").size == (16, 16)


def test_an_orbit_looks_at_the_object_from_all_round(model: Any) -> None:
    cameras = render.orbit_cameras(model, 8)
    for camera in cameras:
        uv, depth = camera.project(np.zeros((1, 3)))
        assert np.allclose(uv, 16)  # the middle of 32 pixels
        assert np.allclose(depth, 4)  # as far as the photos
        above, _ = camera.project(np.array([[0.0, 0.0, 0.1]]))
        assert above[0, 1] < 16  # up is up
    sides = [np.degrees(np.arctan2(c.center[1], c.center[0])) for c in cameras]
    assert np.allclose(np.sort(np.diff(np.unwrap(sides, period=360))), 45)


def test_what_cannot_be_drawn_is_said_in_words(space: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected train, test or all"):
        draw(space, tmp_path, split="none")
    with pytest.raises(InputError, match="no view is in it"):
        draw(space, tmp_path, split="test")
    with pytest.raises(InputError, match="--scale 9"):
        draw(space, tmp_path, scale=9.0)
