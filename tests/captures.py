"""Small captures on disk, and stages run as the engine runs them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64
from refdgs_pipe.pipeline.catalog import load_stages
from refdgs_pipe.pipeline.events import Event, Measured, Warned
from refdgs_pipe.pipeline.stage import Job

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"
EXAMPLE = ROOT / "examples" / "kettle"

needs_shared = pytest.mark.skipif(
    not SHARED.is_dir(), reason="the captures with ground truth (../shared/data) are not here"
)


def picture(seed: int = 0, height: int = 48, width: int = 64) -> np.ndarray:
    """(H, W, 3) uint8 smooth noise."""
    rng = np.random.default_rng(seed)
    small = Image.fromarray(rng.integers(0, 255, (6, 8, 3), np.uint8))
    return np.asarray(small.resize((width, height), Image.Resampling.BICUBIC))


def disc(height: int = 48, width: int = 64) -> np.ndarray:
    """(H, W) uint8 mask: 255 in a disc in the middle."""
    y, x = np.mgrid[0:height, 0:width]
    return np.where(np.hypot(x - width / 2, y - height / 2) < height / 3, 255, 0).astype(np.uint8)


def looking(eye: F64, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> F64:
    """(4, 4) cam_from_world of a level camera at `eye` (3,) that looks at a point."""
    forward = (np.array(at) - eye) / np.linalg.norm(np.array(at) - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def write_photos(folder: Path, count: int = 3, suffix: str = "jpg") -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"IMG_{i}.{suffix}" for i in range(count)]
    for i, path in enumerate(paths):
        Image.fromarray(picture(i)).save(path)
    return paths


@dataclass
class Stages:
    """Runs ingest and sfm below a folder, and remembers what they said."""

    folder: Path
    events: list[Event] = field(default_factory=list)

    def run(self, name: str, inputs: dict[str, Any], settings: dict[str, Any]) -> Any:
        stage = {stage.name: stage for stage in load_stages()}[name]
        out, scratch = self.folder / name, self.folder / f".scratch-{name}"
        out.mkdir(parents=True)
        scratch.mkdir()
        job = Job(name, out, scratch, "cpu", 2, self.events.append)
        made = stage.run(**inputs, params=stage.params(**settings), job=job)
        made.save(out)
        return stage.output.load(out)

    def ingest(self, *paths: Path, **settings: Any) -> Views:
        views = self.run("ingest", {"capture": Capture(paths)}, settings)
        assert isinstance(views, Views)
        return views

    def sfm(self, views: Views, gate: dict[str, Any] | None = None, **settings: Any) -> SparseModel:
        placement = self.run("sfm", {"views": views}, settings)
        model = self.run("gate", {"views": views, "placement": placement}, gate or {})
        assert isinstance(model, SparseModel)
        return model

    @property
    def warnings(self) -> list[str]:
        return [event.text for event in self.events if isinstance(event, Warned)]

    @property
    def measured(self) -> dict[str, Any]:
        return {event.name: event.value for event in self.events if isinstance(event, Measured)}
