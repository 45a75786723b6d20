"""Damaged artifacts on disk are told as such: the engine then makes them again."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import finished
import numpy as np
import pytest

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.artifacts.lighting import BANDS, Flash, Lighting, Ring, Turntable
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.mesh import CleanMesh, Mesh, RawMesh, UvMesh
from refdgs_pipe.artifacts.placement import Attempt, Placement, Poses
from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.artifacts.shape import Shape
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.ground_light import GroundLight

KINDS: list[Any] = [
    Appearance,
    Asset,
    Checkpoint,
    CleanMesh,
    Lighting,
    Masks,
    Mesh,
    Placement,
    RawMesh,
    Scores,
    Shape,
    SparseModel,
    Start,
    SurfelField,
    TexturedMesh,
    UvMesh,
    Views,
]


def appearance() -> Appearance:
    rng = np.random.default_rng(3)

    def values(*shape: int) -> Any:
        return rng.random(shape, np.float32)

    n = 5
    return Appearance(
        values(n, 3),
        values(n),
        values(n),
        values(n, 3),
        values(n, 3),
        values(n, 3),
        values(n),
        values(4, 8, 3),
    )


def over_ground() -> Appearance:
    """An appearance with the light below the object."""
    picture = np.random.default_rng(4).random((6, 6, 4)).astype(np.float16).astype(np.float32)
    axes = (np.array([1.0, 2, 3]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    return replace(appearance(), ground=GroundLight(picture, *axes, radius=2.5))


def test_the_light_below_comes_back(tmp_path: Path) -> None:
    made = over_ground()
    made.save(tmp_path)
    found = Appearance.load(tmp_path).ground
    assert found is not None and made.ground is not None
    assert np.array_equal(found.picture, made.ground.picture)
    for name in ("origin", "a", "b", "radius"):
        assert np.array_equal(getattr(found, name), getattr(made.ground, name))


@pytest.mark.parametrize("name", ["origin", "radius", "file"])
def test_a_damaged_light_below_is_refused(tmp_path: Path, name: str) -> None:
    over_ground().save(tmp_path)
    record = json.loads((tmp_path / "appearance.json").read_text("utf-8"))
    if name == "file":
        (tmp_path / "ground.safetensors").write_bytes(b"broken")
    else:
        record["ground"][name] = float("nan")
    (tmp_path / "appearance.json").write_text(json.dumps(record), "utf-8")
    with pytest.raises(CorruptError, match="appearance again"):
        Appearance.load(tmp_path)


def poses() -> Poses:
    return Poses(
        {"a.png": np.eye(4), "b.png": 2 * np.eye(4)},
        {"a.png": 0, "b.png": 0},
        (("PINHOLE", 8, 6, np.arange(4.0)),),
        np.ones((3, 3)),
        np.zeros((3, 3), np.uint8),
        {"a.png": np.arange(3)},
        0.5,
        "incremental",
    )


SAVED: dict[str, Any] = {
    "appearance": appearance(),
    "poses": Placement(poses()),
    "placement": Placement(None, (Attempt("a", 3, 2, 10),), ("a note",), True, 0.5, np.eye(3)[2]),
    "start": finished.start(),
    "checkpoint": finished.checkpoint(),
    "shape": Shape(None, "no views"),
    "clean": CleanMesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), 7),
    "scores": Scores("test", (), None, 12, {}, None, None),
}


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_an_empty_folder_is_no_artifact(kind: Any, tmp_path: Path) -> None:
    with pytest.raises(CorruptError):
        kind.load(tmp_path)


def test_a_mesh_without_texture_coordinates_is_no_unwrapped_mesh(tmp_path: Path) -> None:
    Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32)).save(tmp_path)
    with pytest.raises(CorruptError, match="no texture coordinates"):
        UvMesh.load(tmp_path)


def test_a_clean_mesh_keeps_the_budget_of_the_fitted_one(tmp_path: Path) -> None:
    CleanMesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), 7).save(tmp_path)
    assert CleanMesh.load(tmp_path).budget == 7
    (tmp_path / "clean.json").write_text('{"budget": []}')
    with pytest.raises(CorruptError, match="run the stage clean again"):
        CleanMesh.load(tmp_path)


def test_views_whose_points_are_damaged_are_told(tmp_path: Path) -> None:
    Views(tmp_path, (), "srgb", "removed", ()).save(tmp_path)
    assert Views.load(tmp_path).items == ()
    (tmp_path / "points.npz").write_bytes(b"PK no archive")
    with pytest.raises(CorruptError, match=r"views\.json"):
        Views.load(tmp_path)


@pytest.mark.parametrize("name", SAVED)
def test_an_artifact_cut_short_anywhere_is_told_as_damaged(name: str, tmp_path: Path) -> None:
    """At the start, the end, and 20 places between."""
    made = SAVED[name]
    whole = tmp_path / "whole"
    whole.mkdir()
    made.save(whole)
    assert type(made).load(whole)
    main = max(whole.iterdir(), key=lambda path: path.suffix != ".json")
    data = main.read_bytes()
    for cut in sorted({0, len(data) - 2, *np.linspace(1, len(data) - 3, 20).astype(int).tolist()}):
        damaged = tmp_path / "damaged"
        shutil.copytree(whole, damaged)
        (damaged / main.name).write_bytes(data[:cut])
        with pytest.raises(CorruptError):
            type(made).load(damaged)
        shutil.rmtree(damaged)


@pytest.mark.parametrize("seed", range(4))
def test_an_appearance_is_read_as_it_was_written(seed: int, tmp_path: Path) -> None:
    """Any number of vertices, with and without light, also numbers at the ends of their range."""
    rng = np.random.default_rng(seed)
    n = int(rng.choice([0, 1, 17, 300]))

    def values(*shape: int) -> Any:
        exponents = rng.integers(-40, 38, shape).astype(np.float32)
        return np.asarray(rng.normal(size=shape) * 10.0**exponents, np.float32)

    height = int(2 ** rng.integers(0, 5))
    made = Appearance(
        values(n, 3),
        values(n),
        values(n),
        values(n, 3),
        values(n, 3),
        values(n, 3),
        values(n),
        values(height, 2 * height, 3) if seed % 2 else None,
    )
    made.save(tmp_path)
    read = Appearance.load(tmp_path)
    for name, value in vars(made).items():
        same = getattr(read, name)
        assert same is None if value is None else np.array_equal(same, value)


TABLE = Turntable(np.zeros(3), np.array([0.0, 0, 1]), (Ring(1, 2, 0.1),), np.ones((BANDS, 3)))
LIGHTS = [
    Lighting("world", "because"),
    Lighting("turntable", "", turntable=TABLE),
    Lighting("flash", "", flash=Flash(np.array([0.0, -0.1, 0]), 3.0, 0.2)),
]


@pytest.mark.parametrize("light", LIGHTS, ids=lambda light: light.kind)
def test_a_lighting_comes_back_as_it_was(light: Lighting, tmp_path: Path) -> None:
    light.save(tmp_path)
    assert Lighting.load(tmp_path).record() == light.record()


@pytest.mark.parametrize(
    "damage",
    [
        {"kind": "moon"},
        {"kind": "flash"},
        {"kind": "flash", "flash": {"lamp": [0, 0], "distance": 1, "room": 0}},
        {"kind": "flash", "flash": {"lamp": [0, 0, 0], "distance": 0, "room": 0}},
        {"kind": "turntable", "turntable": {"rings": []}},
    ],
)
def test_a_damaged_lighting_is_told(damage: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "lighting.json").write_text(json.dumps({"reason": "", **damage}))
    with pytest.raises(CorruptError, match="lighting"):
        Lighting.load(tmp_path)
