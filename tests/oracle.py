"""Ground truth in the place of a result, and ways to spoil it by a known amount."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import solids
from captures import Stages
from PIL import Image
from scenes import Scene, Sphere, gradient_sky, orbit, waves

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.scores import Scores, SurfaceScore
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.truth import view_truth_files
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.evaluation.scoring import Drawing, Protocol, Subject, score
from refdgs_pipe.evaluation.surface import score_surface
from refdgs_pipe.evaluation.truth import read_true_mesh, read_view_truth
from refdgs_pipe.files.ply import write_mesh

RADIUS = 0.8
SIZE = 64


def write_ball(folder: Path) -> Path:
    """A data set of a ball with known poses and all of its truth; every fourth view held out."""
    scene = Scene((Sphere((0.0, 0.0, 0.0), RADIUS, waves),), gradient_sky)
    frames: dict[str, list[object]] = {"train": [], "test": []}
    for i, camera in enumerate(orbit(16, size=SIZE, focal=SIZE * 1.4)):
        split = "test" if i % 4 == 3 else "train"
        (folder / split).mkdir(parents=True, exist_ok=True)
        maps, stem = scene.surface_map(camera), folder / split / f"r_{i}"
        save_png(Path(f"{stem}.png"), maps.color, maps.alpha)
        save_png(Path(f"{stem}_normal.png"), maps.normal / 2 + 0.5, maps.alpha)
        np.savez(Path(f"{stem}_depth.npz"), allow_pickle=False, depth=maps.depth)
        pose = camera.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
        record = {"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()}
        frames[split].append(record)
    for split, records in frames.items():
        text = json.dumps({"camera_angle_x": 2 * np.arctan(0.5 / 1.4), "frames": records})
        (folder / f"transforms_{split}.json").write_text(text)
    mesh = solids.sphere(48, radius=RADIUS)
    write_mesh(folder / "gt_mesh.ply", mesh.vertices, mesh.faces)
    return folder


def save_png(path: Path, color: np.ndarray, alpha: np.ndarray) -> None:
    rgba = np.concatenate([color, alpha[..., None]], -1)
    Image.fromarray(np.round(rgba * 255).astype(np.uint8)).save(path)


@dataclass
class Oracle:
    """Scores the truth of a data set as if it were a result, spoilt as asked for.

    Args:
        root: the data set.
        stages: run ingest and sfm on it.
    """

    root: Path
    stages: Stages
    views: Views = field(init=False)
    model: SparseModel = field(init=False)
    mesh: TriangleMesh = field(init=False)

    def __post_init__(self) -> None:
        self.mesh = read_true_mesh(self.root / "gt_mesh.ply")
        self.views = self.stages.ingest(self.root)
        self.model = self.stages.sfm(self.views)

    def picture(self, camera: Camera) -> np.ndarray:
        with Image.open(self.root / self.views[camera.name].source) as image:
            rgba = np.asarray(image.convert("RGBA"), np.float32) / np.float32(255)
        return rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])

    def maps(self, camera: Camera) -> SurfaceMap:
        truth = read_view_truth(view_truth_files(self.root / self.views[camera.name].source))
        there = np.zeros((camera.height, camera.width), bool)
        unit = np.zeros((*there.shape, 3), np.float32)
        if truth.normal is not None and truth.foreground is not None:
            there = truth.foreground
            unit = truth.normal / np.linalg.norm(truth.normal, axis=-1, keepdims=True)
        depth = np.zeros_like(unit[..., 0]) if truth.depth is None else truth.depth
        rows, columns = (  # the truth's pixels nearest to those of a smaller camera
            ((np.arange(n) + 0.5) * m / n).astype(int)
            for n, m in zip((camera.height, camera.width), there.shape, strict=True)
        )
        there, unit, depth = (a[rows][:, columns] for a in (there, unit, depth))
        nothing = np.zeros_like(unit)
        return SurfaceMap(
            camera,
            depth=depth,
            alpha=there.astype(np.float32),
            normal=np.where(there[..., None], unit, 0).astype(np.float32),
            diffuse=nothing,
            specular=nothing,
            roughness=nothing[..., 0],
            color=nothing,
        )

    @property
    def diagonal(self) -> float:
        used = self.mesh.vertices[np.unique(self.mesh.faces)]
        return float(np.linalg.norm(used.max(0) - used.min(0)))

    def score_surface(self, *, mesh: TriangleMesh) -> SurfaceScore:
        cameras = [camera for camera in self.model.cameras if camera.split == "train"]
        found = score_surface(mesh, cameras, self.mesh)
        assert found is not None
        return found

    def score(
        self,
        *,
        picture: Callable[[np.ndarray], np.ndarray] = lambda image: image,
        maps: Callable[[SurfaceMap], SurfaceMap] = lambda maps: maps,
        protocol: Protocol | None = None,
    ) -> Scores:
        drawing = Drawing(
            lambda camera: picture(self.picture(camera)), lambda camera: maps(self.maps(camera))
        )
        subject = Subject(self.views, self.model, self.mesh, self.root)
        return score(subject, drawing, protocol or Protocol(800))


def turned(maps: SurfaceMap, degrees: float) -> SurfaceMap:
    """Each normal turned by that angle about an axis across it."""
    n = maps.normal.astype(np.float64)
    across = np.cross(n, [0.31, -0.52, 0.8])
    across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    angle = np.radians(degrees)
    there = (maps.alpha > 0)[..., None]
    normal = np.where(there, np.cos(angle) * n + np.sin(angle) * across, 0)
    return replace(maps, normal=normal.astype(np.float32))


def moved(mesh: TriangleMesh, by: tuple[float, float, float]) -> TriangleMesh:
    return TriangleMesh((mesh.vertices + np.array(by)).astype(np.float32), mesh.faces)
