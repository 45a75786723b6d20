"""Pictures and maps of the trained model, for people and for measurements."""

from pathlib import Path
from typing import Any

import numpy as np

from refdgs_pipe.camera import Camera, look_at
from refdgs_pipe.cli.device import choose_device, core_count
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.errors import InputError
from refdgs_pipe.pipeline.atomic import disk_errors
from refdgs_pipe.pipeline.store import load

SPLITS = {"train": ("train",), "test": ("test",), "all": ("train", "test")}
MAPS = ("normal", "alpha", "depth", "diffuse", "specular", "roughness")


def render_views(
    space: Workspace,
    out: Path,
    *,
    split: str,
    orbit: int,
    scale: float,
    device: str,
    threads: int,
) -> int:
    """Write NAME.png (sRGB over white) and NAME.npz (the maps) of each view. Return their count.

    Raises:
        InputError: nothing is trained yet, or no view is in that split.
        WriteError: the folder cannot be written.
    """
    if split not in SPLITS:
        raise InputError(f"--split {split}: expected train, test or all")
    if not 0.0 < scale <= 4.0:
        raise InputError(f"--scale {scale:g}: expected more than 0 and at most 4")
    field = _load(space, "refine")
    model = _load(space, "gate").placed(field.poses, field.ball)
    if orbit:
        cameras = orbit_cameras(model, orbit)
    else:
        cameras = [camera for camera in model.cameras if camera.split in SPLITS[split]]
    if not cameras:
        raise InputError(f"--split {split}: no view is in it. Try --split all")
    from refdgs_pipe.training.render import render_surface_map

    chosen, count = choose_device(device), threads or core_count()
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        for camera in cameras:
            sized = camera.resized(round(camera.width * scale), round(camera.height * scale))
            _write(out, render_surface_map(field, sized, device=chosen, threads=count))
    return len(cameras)


def orbit_cameras(model: Any, count: int) -> list[Camera]:
    """Cameras on a circle round the object, as high and as far as the photos were on average."""
    up, center = model.up, model.ball.center
    towards = np.stack([camera.center - center for camera in model.cameras])
    distance = float(np.median(np.linalg.norm(towards, axis=1)))
    height = float(np.median(towards @ up / np.linalg.norm(towards, axis=1)))
    height = float(np.clip(height, -0.9, 0.9))
    east = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    first = model.cameras[0]
    cameras = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        level = np.sqrt(1 - height**2) * (np.cos(angle) * east + np.sin(angle) * north)
        pose = look_at(center + distance * (level + height * up), center, up)
        name = f"orbit_{i:03d}"
        cameras.append(Camera(name, first.width, first.height, first.K, pose, "test"))
    return cameras


def _load(space: Workspace, stage: str) -> Any:
    step, folder = space.result(stage)
    return load(step.stage.output, folder)


def _write(out: Path, maps: Any) -> None:
    from PIL import Image

    over_white = maps.color + (1.0 - maps.alpha[..., None])
    pixels = np.round(np.clip(over_white, 0.0, 1.0) * 255).astype(np.uint8)
    Image.fromarray(pixels).save(out / f"{maps.camera.name}.png")
    np.savez_compressed(
        out / f"{maps.camera.name}.npz",
        allow_pickle=False,
        **{name: getattr(maps, name) for name in MAPS},
    )
