"""A scene to train on: a NeRF-synthetic folder, or the procedural ball when there is none."""

import json
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import torch
from scenes import Scene, Sphere, gradient_sky, orbit, waves

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.ops import Pinhole
from refdgs_pipe.training.photos import TrainingPhoto

SYNTHETIC_RADIUS = 1.5  # NeRF-synthetic objects lie within this distance of the origin
PROCEDURAL_VIEWS = 40
Pixels = np.ndarray  # (H, W, 4) uint8, straight alpha
View = tuple[Camera, Pixels]


def read_folder(folder: Path, side: int, most: int) -> tuple[list[View], list[View]]:
    """Training and test views of a NeRF-synthetic folder, at most `side` pixels wide."""
    return _read(folder, "train", side, 10_000), _read(folder, "test", side, most)


def _read(folder: Path, split: str, side: int, most: int) -> list[View]:
    from PIL import Image

    record = json.loads((folder / f"transforms_{split}.json").read_text())
    frames = record["frames"]
    frames = frames[:: max(1, len(frames) // most)][:most]
    views = []
    for frame in frames:
        path = folder / frame["file_path"]
        image = Image.open(path if path.suffix else path.with_suffix(".png")).convert("RGBA")
        if image.width > side:
            image = image.resize((side, round(image.height * side / image.width)))
        focal = 0.5 * image.width / np.tan(0.5 * record["camera_angle_x"])
        K = np.array([[focal, 0, image.width / 2], [0, focal, image.height / 2], [0, 0, 1.0]])
        world_from_cam = np.array(frame["transform_matrix"], np.float64)
        world_from_cam[:3, 1:3] *= -1  # OpenGL's camera looks along -z with y up
        pose = np.linalg.inv(world_from_cam)
        name = f"{split}-{Path(frame['file_path']).stem}"
        views.append((Camera(name, image.width, image.height, K, pose, split), np.asarray(image)))
    return views


def _ball(camera: Camera) -> View:
    ball = Sphere((0.0, 0.0, 0.0), 1.0, waves, roughness=0.2, specular=(0.5, 0.5, 0.5))
    maps = Scene((ball,), gradient_sky).surface_map(camera)
    alpha = maps.alpha[..., None]
    color = np.divide(maps.color, alpha, out=np.zeros_like(maps.color), where=alpha > 1e-3)
    pixels = np.concatenate([color, alpha], -1)
    return camera, np.round(pixels.clip(0, 1) * 255).astype(np.uint8)


def procedural(side: int) -> tuple[list[View], list[View]]:
    """A glossy ball on half of the image; every eighth view is for the test."""
    cameras = orbit(PROCEDURAL_VIEWS, size=side, focal=side * 1.57)
    with ProcessPoolExecutor() as pool:
        views = list(pool.map(_ball, cameras))
    test = views[::8]
    return [view for i, view in enumerate(views) if i % 8], test


def photos_of(views: list[View], near: float) -> list[TrainingPhoto]:
    """Views as the trainer takes them."""
    out = []
    for camera, pixels in views:
        rgb = torch.from_numpy(np.ascontiguousarray(pixels[..., :3].transpose(2, 0, 1)))
        mask = torch.from_numpy(np.ascontiguousarray(pixels[..., 3]))
        out.append(TrainingPhoto(camera, Pinhole.of(camera, near), rgb, mask, None))
    return out


def model_of(train: list[View], radius: float) -> tuple[Views, SparseModel]:
    """What the trainer wants to know besides the photos."""
    cameras = tuple(camera for camera, _ in train)
    none = np.zeros((0, 3))
    model = SparseModel(
        cameras=cameras,
        lenses={c.name: Lens(c.K, np.zeros(8)) for c in cameras},
        points=none,
        point_colors=none.astype(np.uint8),
        tracks={},
        ball=Ball(np.zeros(3), radius),
        up=np.array([0.0, 0, 1]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(),
    )
    return Views(Path(), (), "srgb", "removed", ()), model
