"""Photos of a printed ground whose poses are a little off, laid on its print."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import looking
from PIL import Image

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.register import registered

BALL = Ball(np.array([0.0, 0.0, 0.4]), 1.0)
PLANE = np.array([0.0, 0.0, 1.0]), 0.0
GROUND = Ground.under(BALL, *PLANE, 4.0)
SIZE = (400, 300)
TEST_POINTS = np.array([[0, 0, 0.5], [0.5, 0, 0.2], [-0.5, 0, 0.2], [0, 0.5, 0.8], [0, -0.5, 0.1]])


def camera(i: int) -> Camera:
    """One of twelve, all round, every third low."""
    around, up = np.radians(30 * i), np.radians((14, 35, 55)[i % 3])
    eye = 3.4 * np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])
    pose = looking(eye, (0.0, 0.0, 0.4))
    K = np.array([[400.0, 0, SIZE[0] / 2], [0, 400.0, SIZE[1] / 2], [0, 0, 1]])
    return Camera(f"IMG_{i:02d}", *SIZE, K, pose)


def off(shot: Camera) -> Camera:
    """The same after the camera moved, and turned so that what it looks at stays there."""
    turn = cv2.Rodrigues(np.array([0.012, -0.008, 0.004]))[0]
    pose = shot.cam_from_world.copy()
    pose[:3, :3] = turn @ pose[:3, :3]
    pose[:3, 3] += np.array([0.03, 0.045, 0.01])
    return replace(shot, cam_from_world=pose)


def capture(folder: Path, printed: np.ndarray) -> tuple[Views, list[Camera]]:
    """Photos of the print with a dark ball before it, and where they were taken."""
    cameras, items = [camera(i) for i in range(12)], []
    for shot in cameras:
        image = GROUND.drawn(printed.astype(np.float32), shot, 0.3)
        at, depth = shot.project(np.array([[0.0, 0, 0.3]]))
        radius = round(0.3 * shot.K[0, 0] / depth[0])
        cv2.circle(image, at[0].round().astype(int).tolist(), radius, (0.1, 0.1, 0.1), -1)
        pixels = (image * 255).round().clip(0, 255).astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"{shot.name}.png")
        name = shot.name
        exif = Exif()
        items.append(View(name, f"{name}.png", *SIZE, None, "train", exif, 1.0, 0.5, None, name))
    return Views(folder, tuple(items), "srgb", "photo"), cameras


def model(cameras: list[Camera]) -> SparseModel:
    """Poses as structure from motion might leave them: two of the low photos are off."""
    found = tuple(off(c) if c.name in ("IMG_00", "IMG_06") else c for c in cameras)
    lens = Lens(cameras[0].K, np.zeros(8))
    points = np.random.default_rng(1).uniform(-1, 1, (200, 3)) * (1, 1, 0)
    return SparseModel(
        cameras=found,
        lenses={c.name: lens for c in cameras},
        points=points,
        point_colors=np.zeros((200, 3), np.uint8),
        tracks={c.name: np.arange(200) for c in cameras},
        ball=BALL,
        up=np.array([0.0, 0, 1]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(),
    )


def errors(found: SparseModel, cameras: list[Camera]) -> np.ndarray:
    """(N,) px by which each photo shows points of the object elsewhere than it should."""
    pairs = zip(found.cameras, cameras, strict=True)
    return np.array(
        [np.linalg.norm(a.project(TEST_POINTS)[0] - b.project(TEST_POINTS)[0], axis=1).mean()
         for a, b in pairs]
    )  # fmt: skip


def nothing(done: int, total: int) -> None:
    pass


def blots() -> np.ndarray:
    """(900, 900, 3) a print of random colours, coarse and fine."""
    rng = np.random.default_rng(3)
    coarse = cv2.resize(rng.random((60, 60, 3)), (900, 900), interpolation=cv2.INTER_CUBIC)
    fine = cv2.resize(rng.random((300, 300, 1)), (900, 900), interpolation=cv2.INTER_CUBIC)
    return np.asarray((0.6 * coarse + 0.4 * fine[..., None]).clip(0.05, 0.95))


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
