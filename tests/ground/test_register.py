"""Photos of a printed ground whose poses are a little off, laid on its print."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from printed_ground import GROUND, PLANE, blots, capture, errors, model, nothing

from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.register import registered


def test_photos_that_are_off_are_laid_on_the_print(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, blots())
    before = model(cameras)
    assert errors(before, cameras).max() > 3
    found = registered(views, before, PLANE, nothing)
    assert found is not None
    assert errors(found.model, cameras).max() < 0.4
    assert len(found.misses) == 12
    assert found.misses["IMG_00"][0] > 1 > found.misses["IMG_00"][1]


def test_the_number_of_threads_changes_nothing(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, blots())
    one, two = (registered(views, model(cameras), PLANE, nothing, n) for n in (1, 2))
    assert one is not None and two is not None
    for a, b in zip(one.model.cameras, two.model.cameras, strict=True):
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)
        np.testing.assert_array_equal(a.K, b.K)


def test_a_plain_ground_moves_nothing(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, np.full((900, 900, 3), 0.6))
    assert registered(views, model(cameras), PLANE, nothing) is None


def test_a_plane_where_there_is_none_moves_nothing(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, blots())
    tilted = np.array([np.sin(0.4), 0.0, np.cos(0.4)])
    assert registered(views, model(cameras), (tilted, 0.1), nothing) is None


@pytest.mark.parametrize("longer", [1.006, 0.995])
def test_a_focal_length_that_is_off_comes_nearer(tmp_path: Path, longer: float) -> None:
    views, cameras = capture(tmp_path, blots())
    K = np.diag([longer, longer, 1.0]) @ cameras[0].K
    K[:2, 2] = cameras[0].K[:2, 2]
    wrong = replace(
        model(cameras),
        cameras=tuple(replace(c, K=K) for c in cameras),
        lenses={c.name: Lens(K, np.zeros(8)) for c in cameras},
    )
    found = registered(views, wrong, PLANE, nothing)
    assert found is not None
    assert abs(found.model.cameras[0].K[0, 0] / 400 - 1) < 0.6 * abs(longer - 1)
    assert found.model.lenses["IMG_00"].K[0, 0] == found.model.cameras[0].K[0, 0]


def on_bumps(picture: np.ndarray, shot: Camera) -> np.ndarray:
    """(H, W, 3) a photo of a printed ground that is 1 % of the ball's radius high and low."""
    bumps = np.random.default_rng(5).normal(size=(12, 12)).astype(np.float32)
    bumps = cv2.resize(bumps, (800, 800), interpolation=cv2.INTER_CUBIC)
    bumps *= 0.01 / bumps.std()
    rays, center = shot.pixel_rays() @ shot.cam_from_world[:3, :3], shot.center
    height, size = np.zeros(rays.shape[:2]), 2 * GROUND.radius
    for _ in range(8):
        along = (height - center[2]) / np.minimum(rays[..., 2], -1e-3)
        places = center + along[..., None] * rays - GROUND.origin
        across = [places @ axis / size + 0.5 for axis in (GROUND.a, GROUND.b)]
        height = cv2.remap(bumps, *((800 * one).astype(np.float32) for one in across), 1)
    where = [(one * len(picture) - 0.5).astype(np.float32) for one in across]
    image = cv2.remap(picture, *where, cv2.INTER_LINEAR, borderValue=(0.3,) * 4)
    image[rays[..., 2] > -1e-2] = 0.3
    return np.asarray(image, np.float32)


@pytest.mark.parametrize("all_right", [True, False])
def test_a_ground_that_is_not_flat_does_little_harm(
    all_right: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(
            Ground, "drawn", lambda _, picture, shot, outside=0.3: on_bumps(picture, shot)
        )
        views, cameras = capture(tmp_path, blots())
    before = model(cameras)
    if all_right:
        before = replace(before, cameras=tuple(cameras))
    found = registered(views, before, PLANE, nothing)
    assert found is not None
    assert errors(found.model, cameras).max() < 0.5
    assert len(found.misses) == 12
