"""Photos of a printed ground, and where they were taken."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from captures import looking
from PIL import Image

from refdgs_pipe.artifacts.sparse_model import Ball, Lost, SparseModel
from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.ground.plane import Ground

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
    right = right_model(cameras)
    found = tuple(off(c) if c.name in ("IMG_00", "IMG_06") else c for c in right.cameras)
    return replace(right, cameras=found)


def right_model(cameras: list[Camera], lost: tuple[str, ...] = ()) -> SparseModel:
    """The true poses, without those of photos that are lost."""
    lens = Lens(cameras[0].K, np.zeros(8))
    points = np.random.default_rng(1).uniform(-1, 1, (200, 3)) * (1, 1, 0)
    found = tuple(c for c in cameras if c.name not in lost)
    return SparseModel(
        cameras=found,
        lenses={c.name: lens for c in (found if lost else cameras)},
        points=points,
        point_colors=np.zeros((200, 3), np.uint8),
        tracks={c.name: np.arange(200) for c in found},
        ball=BALL,
        up=np.array([0.0, 0, 1]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=tuple(Lost(name, "no features") for name in lost),
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


def blots(seed: int = 3) -> np.ndarray:
    """(900, 900, 3) a print of random colours, coarse and fine."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.random((60, 60, 3)), (900, 900), interpolation=cv2.INTER_CUBIC)
    fine = cv2.resize(rng.random((300, 300, 1)), (900, 900), interpolation=cv2.INTER_CUBIC)
    return np.asarray((0.6 * coarse + 0.4 * fine[..., None]).clip(0.05, 0.95))
