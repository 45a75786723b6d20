"""A whole training step: wall milliseconds at one and two threads, on a procedural scene.

pytest -m benchmark -s tests/benchmarks/bench_step.py
"""

import statistics
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import Scene, Sphere, gradient_sky, orbit, waves
from training_runs import Settings, trainer_of

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Exif, KnownPose, View, Views
from refdgs_pipe.camera import Lens

pytestmark = pytest.mark.benchmark
WARM, STEPS = 30, 40


def capture(folder: Path, size: int) -> tuple[Views, SparseModel]:
    """A glossy ball on half of the image, twelve views."""
    ball = Sphere((0.0, 0.0, 0.0), 1.0, waves, roughness=0.2, specular=(0.5, 0.5, 0.5))
    cameras = orbit(12, size=size, focal=size * 1.57)  # the ball's disc: 0.8 of the width
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    items = []
    for camera in cameras:
        maps = Scene((ball,), gradient_sky).surface_map(camera)
        for kind, pixels in (("images", maps.color), ("masks", maps.alpha)):
            file = folder / f"{kind}/{camera.name}.png"
            Image.fromarray(np.round(pixels * 255).clip(0, 255).astype(np.uint8)).save(file)
        pose = KnownPose(Lens(camera.K, np.zeros(8)), camera.cam_from_world)
        name, image = camera.name, f"images/{camera.name}.png"
        mask = f"masks/{name}.png"
        items.append(View(name, image, size, size, mask, "train", Exif(), 1, 0.5, pose, name))
    model = SparseModel(
        cameras=tuple(cameras),
        lenses={c.name: Lens(c.K, np.zeros(8)) for c in cameras},
        points=np.zeros((0, 3)),
        point_colors=np.zeros((0, 3), np.uint8),
        tracks={},
        ball=Ball(np.zeros(3), 1.1),
        up=np.array([0.0, 0, 1]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(),
    )
    return Views(folder, tuple(items), "srgb", "removed", ()), model


@pytest.mark.parametrize(
    ("size", "surfels", "local"), [(400, 20_000, 8_000), (800, 100_000, 30_000)]
)
def test_step(tmp_path: Path, size: int, surfels: int, local: int) -> None:
    views, model = capture(tmp_path / "views", size)
    params = Settings.of({}).but(
        iterations=1000,
        coarse_until=0.0,
        reflect_from=0.0,
        local_from=0.0,
        densify_until=0.0,
        surfels=surfels,
        max_surfels=surfels,
        local_surfels=local,
        max_local_surfels=local,
        masked="hull",
        renew_at=1.0,
    )
    before = torch.get_num_threads()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        (tmp_path / str(threads)).mkdir()
        trainer = trainer_of(views, model, params, tmp_path / str(threads))
        for _ in range(WARM):
            trainer.step()
        wall, core = [], time.process_time()
        for _ in range(STEPS):
            start = time.perf_counter()
            trainer.step()
            wall.append((time.perf_counter() - start) * 1e3)
        core = (time.process_time() - core) / STEPS * 1e3
        print(
            f"\n{size}x{size}, {surfels} + {local} surfels, {threads} threads: "
            f"median {statistics.median(wall):.1f} ms wall, {core:.1f} core-ms",
            end="",
        )
    torch.set_num_threads(before)
