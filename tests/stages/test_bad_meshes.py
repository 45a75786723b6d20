"""Meshes that something is wrong with, as fused or as adopted: an asset all the same, or an error
that says what to do."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import finished
import numpy as np
import pytest
from scenes import Scene, Sphere, gradient_sky, orbit, waves
from solids import (
    sphere,
    touching_pieces,
    turned_face,
    two_pieces,
    volume,
    with_fin,
    with_flat_face,
    with_nan,
)
from stage_runs import FIELD, NO_MASKS, Run, model_of, show, show_photos

from refdgs_pipe.artifacts.mesh import CleanMesh, Mesh, RawMesh, TriangleMesh, UvMesh
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.errors import CorruptError, InputError, MeshError
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.validate import glb_faults
from refdgs_pipe.files.ply import write_mesh
from refdgs_pipe.surface.topology import defects, pieces
from refdgs_pipe.texture.charts import seam_split
from refdgs_pipe.texture.programs import one_by_one_corners

SCENE = Scene((Sphere((0, 0, 0), 1.0, waves),), gradient_sky)
MODEL = model_of(orbit(12), Ball(np.zeros(3), 1.2))


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    show(monkeypatch, SCENE.surface_map)
    show_photos(monkeypatch, SCENE.surface_map)
    return Run(tmp_path)


WRONG = [with_fin, with_flat_face, two_pieces, touching_pieces]


@pytest.mark.parametrize("spoilt", [*WRONG, with_nan])
def test_a_bad_fused_mesh_is_cleaned(spoilt: Callable[[TriangleMesh], Any], run: Run) -> None:
    bad = spoilt(sphere(20))
    raw = RawMesh(bad.vertices, bad.faces)
    mesh: CleanMesh = run("clean", raw, FIELD, MODEL, hole=0.3)
    assert not defects(mesh).any and np.isfinite(mesh.vertices).all()
    apart = spoilt in (two_pieces, touching_pieces)
    assert pieces(mesh).max() == (1 if apart else 0)
    assert volume(mesh) == pytest.approx(4.19 + 0.11 * apart, rel=0.05)


@pytest.mark.parametrize("spoilt", [*WRONG, turned_face])
def test_a_bad_adopted_mesh_becomes_an_asset(
    spoilt: Callable[[TriangleMesh], TriangleMesh], run: Run, tmp_path: Path
) -> None:
    bad = spoilt(sphere(20))
    write_mesh(tmp_path / "mine.ply", bad.vertices, bad.faces)
    mesh = Mesh.adopt(tmp_path / "mine.ply")
    atlas: UvMesh = run("unwrap", mesh)
    assert len(atlas.faces) == len(bad.faces)
    looks = finished.appearance(mesh.vertices)
    photos = finished.views(tmp_path / "photos")
    textured: TexturedMesh = run(
        "bake", atlas, looks, FIELD, MODEL, photos, NO_MASKS, size=128, refine=False
    )
    assert np.isfinite(textured.tangents).all()
    run("export", textured, looks, FIELD, MODEL, photos, preview=64)
    assert glb_faults(tmp_path / "export" / "asset.glb") == []


def test_an_adopted_mesh_without_faces_or_with_nan_is_refused(tmp_path: Path) -> None:
    solid, path = sphere(8), tmp_path / "mine.ply"
    write_mesh(path, solid.vertices, solid.faces[:0])
    with pytest.raises(CorruptError, match=r"mine\.ply: holds no triangles"):
        Mesh.adopt(path)
    bad = with_nan(solid)
    write_mesh(path, bad.vertices, bad.faces)
    with pytest.raises(CorruptError, match=r"mine\.ply: holds vertices that are not finite"):
        Mesh.adopt(path)


def test_an_adopted_mesh_from_elsewhere_is_told_at_the_bake(run: Run) -> None:
    solid = sphere(8, center=(50, 0, 0))
    mesh = seam_split(solid, one_by_one_corners(len(solid.faces)))
    looks = finished.appearance(mesh.vertices)
    with pytest.raises(MeshError, match="drop the adopted mesh"):
        run(
            "bake",
            mesh,
            looks,
            FIELD,
            MODEL,
            finished.views(run.folder / "photos"),
            NO_MASKS,
            size=64,
        )


def test_an_empty_fused_mesh_is_told_at_the_cleaning(run: Run) -> None:
    nothing = RawMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    with pytest.raises(MeshError, match="look at the fused mesh"):
        run("clean", nothing, FIELD, MODEL)


@pytest.mark.parametrize("name", ["base_color", "roughness", "normal", "confidence"])
def test_a_missing_texture_is_named(name: str, tmp_path: Path) -> None:
    finished.textured(64).save(tmp_path)
    (tmp_path / f"{name}.png").unlink()
    with pytest.raises(CorruptError, match=f"{name}.png"):
        TexturedMesh.load(tmp_path)


@pytest.mark.slow
def test_a_million_faces_are_brought_within_the_budget(run: Run) -> None:
    # Measured: 27 core-seconds, 0.6 GB.
    solid = sphere(500)
    random = np.random.default_rng(0)
    rough = solid.vertices * (1 + 0.0005 * random.normal(size=(len(solid.vertices), 1)))
    raw = RawMesh(rough.astype(np.float32), solid.faces)
    mesh: CleanMesh = run("clean", raw, FIELD, MODEL)
    assert 45_000 < len(mesh.faces) <= 50_000 and not defects(mesh).any
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1).max() < 0.003


def test_an_adopted_mesh_lies_where_the_one_it_replaces_does() -> None:
    vertices = np.random.default_rng(0).random((50, 3)).astype(np.float32) * [1, 1, 1.6]
    faces = np.array([[0, 1, 2]], np.int32)
    before = Mesh(vertices.astype(np.float32), faces)
    edited = Mesh((vertices + 0.05).astype(np.float32), faces)
    edited.placed_like(before)
    cut = Mesh(vertices[vertices[:, 2] < 0.8].astype(np.float32), faces)
    cut.placed_like(before)
    exported = AssetFrame.of(np.array([0.0, 0.0, 1.0]), 1.0).points(vertices)
    for elsewhere in (exported, 0.1 * vertices):
        with pytest.raises(InputError, match="Exported files are in metres"):
            Mesh(elsewhere.astype(np.float32), faces).placed_like(before)
