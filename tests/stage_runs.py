"""Stages as the engine runs them, with given maps in place of a trained field."""

from importlib import import_module
from pathlib import Path
from typing import Any

import finished
import numpy as np
import pytest

from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.pipeline.events import Event, Measured, Warned
from refdgs_pipe.pipeline.stage import Job

FIELD = finished.field()
NO_MASKS = Masks(Path(), (), "given")


class Run:
    """Runs stages with given maps in place of a trained field."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.events = folder, list[Event]()

    def __call__(self, name: str, *inputs: object, **settings: object) -> Any:
        stage = getattr(import_module(f"refdgs_pipe.stages.{name}"), name)
        out, scratch = self.folder / name, self.folder / "scratch"
        for path in (out, scratch):
            path.mkdir(exist_ok=True)
        job = Job(name, out, scratch, "cpu", 2, self.events.append)
        artifact = stage.run(*inputs, stage.params(**settings), job)
        artifact.save(out)
        return stage.output.load(out)

    def measured(self, stage: str) -> dict[str, Any]:
        found = [e for e in self.events if isinstance(e, Measured) and e.stage == stage]
        return {e.name: e.value for e in found}

    def warnings(self) -> list[str]:
        return [e.text for e in self.events if isinstance(e, Warned)]


def model_of(cameras: list[Camera], ball: Ball) -> SparseModel:
    return SparseModel(
        cameras=tuple(cameras),
        lenses={},
        points=np.empty((0, 3)),
        point_colors=np.empty((0, 3), np.uint8),
        tracks={},
        ball=ball,
        up=np.array([0.0, 0.0, 1.0]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(),
    )


def show(monkeypatch: pytest.MonkeyPatch, view: Any) -> None:
    """Let `view(camera)` stand for the renders of a field."""
    monkeypatch.setattr(
        "refdgs_pipe.training.render.render_surface_map", lambda field, camera, **_: view(camera)
    )


def show_photos(monkeypatch: pytest.MonkeyPatch, view: Any) -> None:
    """Let `view(camera)` stand for photos without masks too."""

    def photo(views: Views, model: SparseModel, camera: Camera, *, scale: float = 1.0) -> Photo:
        sized = camera.resized(round(camera.width * scale), round(camera.height * scale))
        color = view(sized).color
        return Photo(sized, color, None, np.ones(color.shape[:2], bool))

    monkeypatch.setattr("refdgs_pipe.artifacts.photos.load_photo", photo)
