"""A finished workspace in miniature: every artifact of the real stages, without running them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from painted import textured
from scenes import orbit

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.mesh import CleanMesh, Mesh, RawMesh
from refdgs_pipe.artifacts.object_figures import ObjectFigures
from refdgs_pipe.artifacts.placement import Attempt, Evidence, Placement, Poses
from refdgs_pipe.artifacts.scores import Scores, ViewScore
from refdgs_pipe.artifacts.shape import Shape
from refdgs_pipe.artifacts.sparse_model import Ball, Lost, SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.surfel_field import ShaderModel, SurfelField, SurfelSet
from refdgs_pipe.artifacts.views import Exif, Skipped, View, Views
from refdgs_pipe.camera import Lens
from refdgs_pipe.export import files
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.product import product
from refdgs_pipe.files.images import write_png
from refdgs_pipe.pipeline.catalog import load_stages
from refdgs_pipe.pipeline.plan import Step
from refdgs_pipe.pipeline.store import Origin, Record, Store

CAMERAS = orbit(6, size=48, focal=60.0)
UP = np.array([0.0, 0.0, 1.0])
EVIL = '<script>alert("1")</script>.jpg'
SECONDS = 12.5


def views(folder: Path) -> Views:
    """Six photos, the first with an unkind name, the second blurred; a file that is no photo."""
    random = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    items = []
    for i, camera in enumerate(CAMERAS):
        file = f"images/{camera.name}.png"
        write_png(folder / file, random.integers(0, 255, (48, 48, 3)).astype(np.uint8))
        source = EVIL if i == 0 else f"{camera.name}.jpg"
        split = "test" if i == 2 else "train"
        sharpness = 1.0 if i == 1 else 500.0
        items.append(
            View(camera.name, file, 48, 48, None, split, Exif(), sharpness, 0.3, None, source)
        )
    skipped = (Skipped("<b>bad.jpg", "the JPEG ends early"),)
    return Views(folder, tuple(items), "srgb", "photo", skipped)


def model() -> SparseModel:
    """Five cameras, the third held out, and a lost photo."""
    cameras = [replace(c, split="test" if i == 2 else "train") for i, c in enumerate(CAMERAS)]
    lens = Lens(CAMERAS[0].K, np.zeros(8))
    return SparseModel(
        cameras=tuple(cameras[:5]),
        lenses={camera.name: lens for camera in cameras[:5]},
        points=np.random.default_rng(1).normal(size=(40, 3)),
        point_colors=np.zeros((40, 3), np.uint8),
        tracks={},
        ball=Ball(np.array([0.0, 0.0, 1.0]), 1.2),
        up=UP,
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(Lost(CAMERAS[5].name, "only 3 <matches>"),),
    )


def field() -> SurfelField:
    """A few opaque surfels round (0, 0, 1)."""
    random = np.random.default_rng(2)
    quats = random.normal(size=(60, 4)).astype(np.float32)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    values = {
        "diffuse": random.random((60, 3), np.float32),
        "roughness": np.full((60, 1), 0.3, np.float32),
    }
    means = (random.normal(size=(60, 3)) * 0.4 + [0, 0, 1]).astype(np.float32)
    scales, opacities = np.full((60, 2), 0.2, np.float32), np.full(60, 0.9, np.float32)
    geometry = SurfelSet(means, quats, scales, opacities, values)
    none = SurfelSet(means[:0], quats[:0], scales[:0], opacities[:0], {})
    layers = [(64, 4), (64, 64), (64, 64), (3, 64)]
    shader = ShaderModel(
        True,
        "none",
        "adaptive",
        False,
        random.normal(size=(16, 32, 4)).astype(np.float32),
        tuple((random.normal(size=shape) * 0.1).astype(np.float32) for shape in layers),
        tuple(np.zeros(shape[0], np.float32) for shape in layers),
    )
    return SurfelField(geometry, none, none, shader, near=0.05)


def start() -> Start:
    """Four surfels on a square."""
    raw = {
        "means": np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]], np.float32),
        "quats": np.tile(np.float32([1, 0, 0, 0]), (4, 1)),
        "log_scales": np.full((4, 2), -1, np.float32),
        "raw_opacities": np.zeros(4, np.float32),
    }
    return Start(
        geometry=raw,
        local=raw,
        background=None,
        faint=False,
        covers={"a": np.full((3, 2), 255, np.uint8)},
        ball=Ball(np.array([0.0, 0.0, 1.0]), 1.2),
        random=np.zeros(8, np.uint8),
        seed=3,
        max_side=48,
        ground="background",
        surfels=4,
        background_surfels=9,
        bfloat16=True,
    )


def checkpoint() -> Checkpoint:
    """A training that is not through."""
    tensors = {"geometry/adam.means.step": np.array(7, np.float32), "rng": np.zeros(8, np.uint8)}
    figures = {"iteration": 7, "loss": 0.1, "psnr": 20.0, "skipped": 0, "early": None}
    return Checkpoint(field(), tensors, figures, {"iterations": 9}, 48, 0.9)


def appearance(points: np.ndarray, *, received: float = 1.0) -> Appearance:
    """Plain plastic under white light, for these vertices."""
    ones = np.ones(len(points), np.float32)
    wide = np.ones((len(points), 3), np.float32)
    light = np.full((16, 32, 3), received, np.float32)
    return Appearance(
        points, 0.3 * ones, 0 * ones, wide, wide, wide * np.float32(received), ones, light
    )


def asset(folder: Path) -> Asset:
    """The exported files of a small textured ball."""
    made = product(textured(64), up=UP, metres_per_unit=0.1)
    frame, light = AssetFrame.of(UP, 0.1), np.ones((8, 16, 3), np.float32)
    around = files.Surroundings(frame, light, CAMERAS, field().geometry)
    for write in files.writers(around, preview=64):
        write(folder, made)
    return Asset.of(folder, faces=len(made.faces), texture_size=64)


def half_placed() -> Placement:
    """Five of six photos placed, two of them where their matches contradict it."""
    names = [f"{camera.name}.png" for camera in CAMERAS]
    points = np.random.default_rng(3).normal(size=(60, 3)) * 0.3 + [0, 0, 1]
    pairs = np.array([(a, b) for a in range(6) for b in range(a + 1, 6)], np.int32)
    known, good = (pairs < 5).all(1), (pairs < 3).all(1)
    counts = np.full(len(pairs), 100, np.int32)
    evidence = Evidence(
        names=tuple(names),
        features=np.full(6, 500, np.int32),
        still=np.zeros(6),
        moves=np.where(np.arange(6) < 5, 0.001, np.nan),
        pairs=pairs,
        matches=counts,
        inliers=np.where(known, counts, 3).astype(np.int32),
        agree=np.where(known, np.where(good, 1.0, 0.1), np.nan),
        shared=np.where(known, 60, 0).astype(np.int32),
        held=np.zeros(len(pairs), np.bool_),
        angle=np.where(known, 20.0, np.nan),
    )
    poses = Poses(
        cam_from_world={n: c.cam_from_world for n, c in zip(names[:5], CAMERAS, strict=False)},
        lens_of=dict.fromkeys(names[:5], 0),
        lenses=(("PINHOLE", 48, 48, np.array([60.0, 60.0, 24.0, 24.0])),),
        points=points,
        colors=np.zeros((60, 3), np.uint8),
        tracks={name: np.arange(60) for name in names[:5]},
        error_px=0.5,
        mapper="incremental",
        evidence=evidence,
    )
    note = "the background stands still while the object turns"
    return Placement(poses, (Attempt("features as <set>", 5, 3, 60),), (note,))


FINE = ObjectFigures(
    photos=6,
    placed=6,
    psnr=32.0,
    training_psnr=32.5,
    asset_psnr=28.0,
    outline=0.3,
    depth=0.1,
    contradicted=0.0,
    seen=0.95,
    unseen=0.0,
)


def steps(
    store: Store,
    *,
    until: str = "evaluate",
    warning: str = "",
    placement: Placement | None = None,
    evidence: ObjectFigures | None = FINE,
) -> list[Step]:
    """Commit the results of all stages up to `until`, and say how each stage stands."""
    mesh = textured(64)
    makers: dict[str, Callable[[Path], Any]] = {
        "ingest": views,
        "sfm": lambda folder: placement or Placement(None, known=True),
        "gate": lambda folder: model(),
        "lighting": lambda folder: Lighting("world", "the ground does not darken"),
        "masks": lambda folder: Masks(folder, (), "none", "no plane"),
        "start": lambda folder: start(),
        "train": lambda folder: checkpoint(),
        "shape": lambda folder: Shape(None),
        "refine": lambda folder: field(),
        "extract": lambda folder: RawMesh(mesh.mesh.vertices, mesh.mesh.faces),
        "clean": lambda folder: CleanMesh(mesh.mesh.vertices, mesh.mesh.faces, 2000),
        "fit": lambda folder: Mesh(mesh.mesh.vertices, mesh.mesh.faces),
        "appearance": lambda folder: appearance(mesh.mesh.vertices),
        "unwrap": lambda folder: mesh.mesh,
        "bake": lambda folder: mesh,
        "export": asset,
        "evaluate": lambda folder: Scores(
            "test", (ViewScore(CAMERAS[2].name, 20.0, 20.1, 0.9),), evidence=evidence
        ),
    }
    found, is_over = [], False
    for stage in load_stages():
        if is_over:
            found.append(Step(stage, "missing", "never run"))
            continue
        origin = Origin(stage.name, stage.version, {}, {})
        partial = store.partial(origin)
        makers[stage.name](partial).save(partial)
        warnings = (warning,) if warning and stage.name == "gate" else ()
        record = Record(SECONDS, {}, (("faces", 12, ""),), warnings)
        manifest = store.commit(partial, origin, record)
        found.append(Step(stage, "up to date", "up to date", origin, manifest))
        is_over = stage.name == until
    return found


def log(store: Store, *events: dict[str, Any], name: str = "1") -> None:
    """Write the log of a run."""
    (store.root / "logs").mkdir(parents=True, exist_ok=True)
    text = "".join(json.dumps(event) + "\n" for event in events)
    (store.root / "logs" / f"{name}.jsonl").write_text(text)
