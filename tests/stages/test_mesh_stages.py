"""From maps of a surface to files, through the stages as the engine runs them."""

import json
import re
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import finished
import numpy as np
import pytest
import truth
from scenes import Box, glossy_pair, gradient_sky, orbit, waves
from scenes import Scene as Procedural
from stage_runs import FIELD, NO_MASKS, Run, model_of, show, show_photos

from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.mesh import Mesh, RawMesh, UvMesh
from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.camera import Lens
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.errors import MeshError
from refdgs_pipe.files.images import write_png
from refdgs_pipe.texture.texels import rasterize


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path)


def photos(run: Run) -> Views:
    return finished.views(run.folder / "photos")


def baked(run: Run, mesh: Mesh, model: SparseModel, *, size: int) -> TexturedMesh:
    """The mesh with textures of that size, seen in the run's photos."""
    looks = finished.appearance(mesh.vertices)
    atlas: UvMesh = run("unwrap", mesh)
    done: TexturedMesh = run(
        "bake", atlas, looks, FIELD, model, photos(run), NO_MASKS, size=size, refine=False
    )
    return done


def test_a_procedural_scene_becomes_files(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = glossy_pair()
    show(monkeypatch, scene.surface_map)
    show_photos(monkeypatch, scene.surface_map)
    model = model_of(orbit(24), Ball(np.zeros(3), 1.2))
    raw: RawMesh = run("extract", FIELD, model, voxel=0.01)
    mesh: Mesh = run("fit", run("clean", raw, FIELD, model, faces=8000), FIELD, model)
    atlas: UvMesh = run("unwrap", mesh)
    looks = finished.appearance(mesh.vertices)
    textured: TexturedMesh = run(
        "bake", atlas, looks, FIELD, model, photos(run), NO_MASKS, size=512, refine=False
    )
    asset: Asset = run(
        "export",
        textured,
        looks,
        FIELD,
        model,
        finished.views(run.folder / "photos"),
        longest=0.5,
        preview=64,
    )

    assert scene.distance(raw.vertices.astype(float)).mean() < 0.15 * 0.024
    assert len(mesh.faces) <= 8000
    assert scene.distance(mesh.vertices.astype(float)).mean() < 0.2 * 0.024
    texels = rasterize(atlas, 512)
    points = texels.interpolate(atlas, atlas.vertices).astype(float)
    base = linear_from_srgb(textured.base_color.reshape(-1, 3)[texels.index] / np.float32(65535))
    error = np.abs(base - scene.diffuse(points)).mean(1)
    assert error.mean() < 0.01
    names = {file.name for file in asset.files}
    assert {"asset.glb", "asset.usdz", "asset.obj", "splats.ply", "preview.png"} <= names
    assert {"environment.hdr", "scene.usda"} <= names
    assert asset.faces == len(mesh.faces) and asset.texture_size == 512
    assert run.measured("fit")["faces"] == len(mesh.faces)
    # as a whole or in parts: atlases of nearly the same worth, and meshes differ by processor
    assert str(run.measured("unwrap")["program"]).startswith("UVAtlas")
    assert run.measured("bake")["texels seen"] > 0.98
    assert run.warnings() == []


def test_what_the_user_should_know_is_said(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Procedural((glossy_pair().solids[0],), gradient_sky)
    show(monkeypatch, scene.surface_map)
    show_photos(monkeypatch, scene.surface_map)
    above = [c for c in orbit(30) if c.center[2] > 1]
    model = model_of(above, Ball(np.zeros(3), 1.2))
    whole = model_of(orbit(30), Ball(np.zeros(3), 1.2))
    raw = run("extract", FIELD, whole, voxel=0.02)
    mesh = run("fit", run("clean", raw, FIELD, whole, faces=2000), FIELD, whole)
    looks = finished.appearance(mesh.vertices)
    textured = baked(run, mesh, model, size=128)
    run("export", textured, looks, FIELD, model, photos(run), preview=64)
    (seen,) = run.warnings()
    assert "was seen by no camera" in seen
    size = run.measured("export")["size"]
    told = re.search(r"unknown: exported ([0-9.]+) m long", size)
    assert told is not None and float(told[1]) == pytest.approx(1.0, abs=0.005)
    assert "--size" in size


def test_the_table_is_kept_or_not_as_asked(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    board = Box((-1.0, -1.0, -0.6), (1.0, 1.0, -0.5), waves)
    crate = Box((-0.3, -0.2, -0.5), (0.3, 0.2, 0.3), waves)
    show(monkeypatch, Procedural((board, crate), gradient_sky).surface_map)
    above = [c for c in orbit(30) if c.center[2] > 0.5]
    model = model_of(above, Ball(np.zeros(3), 1.0))
    raw = run("extract", FIELD, model, voxel=0.012)
    everything = run("clean", raw, FIELD, model)
    crate_only = run("clean", raw, FIELD, model, faces=4000, keep="object")
    assert run.warnings() == [] and run.measured("clean")["support's share of the area"] > 0.3
    assert crate_only.vertices[:, 2].min() == pytest.approx(-0.5, abs=0.01)
    assert np.abs(crate_only.vertices[:, :2]).max() < 0.4
    over_foot = crate_only.vertices[crate_only.vertices[:, 2] > -0.4]  # fusion rounds the foot
    np.testing.assert_allclose(over_foot.max(0), (0.3, 0.2, 0.3), atol=0.03)
    assert np.ptp(everything.vertices[:, 0]) > 1.5


def test_a_missing_table_is_said_and_everything_stays(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    show(monkeypatch, glossy_pair().surface_map)
    model = model_of(orbit(24), Ball(np.zeros(3), 1.2))
    raw = run("extract", FIELD, model, voxel=0.02)
    mesh = run("clean", raw, FIELD, model, keep="object")
    (said,) = run.warnings()
    assert "found no level surface" in said and "gate.up" in said
    np.testing.assert_array_equal(mesh.vertices, run("clean", raw, FIELD, model).vertices)


def test_a_base_that_cannot_be_closed_is_said(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    show(monkeypatch, glossy_pair().surface_map)
    model = model_of(orbit(24), Ball(np.zeros(3), 1.2))  # no points, so no ground
    raw = run("extract", FIELD, model, voxel=0.02)
    run("clean", raw, FIELD, model, base="closed")
    (said,) = run.warnings()
    assert "the base stays open" in said and "textured table" in said


def test_an_empty_field_stops_at_extract(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    show(monkeypatch, Procedural((glossy_pair().solids[0],), waves).surface_map)
    model = model_of(orbit(4), Ball(np.array([9.0, 0, 0]), 0.5))
    with pytest.raises(MeshError, match="no view shows a surface"):
        run("extract", FIELD, model)


def test_texture_sizes_are_powers_of_two(run: Run) -> None:
    params = import_module("refdgs_pipe.stages.bake").BakeParams
    with pytest.raises(ValueError, match="a power of two, such as 512 or 1024"):
        params(size=1000)


@pytest.mark.parametrize("lit", [True, False])
def test_noise_in_photos_is_no_detail(
    run: Run, monkeypatch: pytest.MonkeyPatch, *, lit: bool
) -> None:
    """Larger textures are enlarged, and photos of noise add next to nothing to them."""
    scene = glossy_pair()
    show(monkeypatch, scene.surface_map)
    model = model_of(orbit(8), Ball(np.zeros(3), 1.2))
    lenses = {camera.name: Lens(camera.K, np.zeros(8)) for camera in model.cameras}
    model = replace(model, lenses=lenses)
    raw = run("extract", FIELD, model, voxel=0.02)
    mesh = run("fit", run("clean", raw, FIELD, model, faces=2000), FIELD, model)
    looks = finished.appearance(mesh.vertices)
    looks = looks if lit else replace(looks, environment=None)
    atlas = run("unwrap", mesh)
    monkeypatch.setattr("refdgs_pipe.texture.settings.PAINTED_SIDE", 128)
    given = (atlas, looks, FIELD, model, noise(run.folder, model), NO_MASKS)
    textures = [
        run("bake", *given, size=256, refine=False, detail=detail) for detail in (False, True)
    ]
    assert [one.size for one in textures] == [256, 256]
    plain, found = (one.base_color.astype(float) / 65535 for one in textures)
    assert np.abs(plain - found).mean() < 0.03


def noise(folder: Path, model: SparseModel) -> Views:
    """A photo of noise for each camera."""
    random = np.random.default_rng(0)
    (folder / "noise").mkdir()
    items = []
    for camera in model.cameras:
        name, width, height = camera.name, camera.width, camera.height
        file = f"noise/{name}.png"
        write_png(folder / file, random.integers(0, 255, (height, width, 3)).astype(np.uint8))
        items.append(View(name, file, width, height, None, "train", Exif(), 500.0, 0.3, None, name))
    return Views(folder, tuple(items), "srgb", "photo", ())


@pytest.mark.slow
@truth.needs_scenes
@pytest.mark.parametrize("name", ["spheres", "kettle", "mug"])
def test_true_maps_give_the_true_asset(
    run: Run, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    # Measured with 16 views of 320 px: surface 0.06 to 0.11 voxels, colour 0.006 to 0.022 (sharp
    # patterns at 2 texels a pixel), normals 0.3 to 0.5 degrees against 1.5 to 1.9 of the mesh.
    show(monkeypatch, lambda camera: truth.surface_map(name, camera))
    show_photos(monkeypatch, lambda camera: truth.surface_map(name, camera))
    model = truth.sparse_model(name)
    raw = run("extract", FIELD, model)
    mesh = run("fit", run("clean", raw, FIELD, model), FIELD, model)
    looks = finished.appearance(mesh.vertices)
    textured = baked(run, mesh, model, size=1024)
    photos_of = finished.views(run.folder / "photos")
    asset = run("export", textured, looks, FIELD, model, photos_of, preview=240)
    found = truth.distances(mesh.vertices, *truth.mesh(name))
    assert found.mean() < 0.2 * 0.004 * 2 * model.ball.radius
    errors = np.array([truth.errors(textured, truth.surface_map(name, c)) for c in model.cameras])
    color, normal, smooth = np.nanmean(errors[:, :3], axis=0)
    record = json.dumps({"surface": float(found.mean()), "errors": errors.mean(0).tolist()})
    assert color < 0.03, record
    assert normal < 0.8 and normal < smooth / 2, record
    assert asset.faces <= 50_000


def test_maps_are_what_the_scene_is() -> None:
    """The procedural maps agree with themselves: points lie on surfaces, normals face the eye."""
    scene, camera = glossy_pair(), orbit(3, size=64, focal=80)[1]
    view: SurfaceMap = scene.surface_map(camera)
    rays = camera.pixel_rays() @ camera.cam_from_world[:3, :3]
    points = camera.center + rays * view.depth[..., None]
    here = view.depth > 0
    assert scene.distance(points[here]).max() < 1e-5
    assert ((rays * view.normal).sum(-1)[here] < 0).all()
