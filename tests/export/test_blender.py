"""What arrives in Blender: run with  pytest -m dcc, BPY_PYTHON naming a Python that has bpy."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import finished
import numpy as np
import pytest
from painted import textured
from scenes import orbit
from solids import sphere

from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.export.files import Surroundings, glb, writers
from refdgs_pipe.export.frame import AssetFrame, latlong_directions
from refdgs_pipe.export.product import product
from refdgs_pipe.texture.charts import unwrap
from refdgs_pipe.texture.tangents import mikktspace

pytestmark = pytest.mark.dcc
UP = np.array([0.0, 0.0, 1.0])
BRIGHT = np.array([0.6, 0.0, 0.8])  # of the asset's axes
SCRIPT = Path(__file__).parent / "look_in_blender.py"


def look(path: Path, *sides: str) -> dict[str, Any]:
    python, blender = os.environ.get("BPY_PYTHON"), shutil.which("blender")
    if python:
        command = [python, str(SCRIPT), str(path), *sides]
    elif blender:
        options = ["--background", "--factory-startup", "--python-exit-code", "3", "--python"]
        command = [blender, *options, str(SCRIPT), "--", str(path), *sides]
    else:
        pytest.skip("no Blender: set BPY_PYTHON, or have blender on the PATH")
    run = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert run.returncode == 0, run.stdout + run.stderr
    record: dict[str, Any] = json.loads(run.stdout.rpartition("RECORD ")[2].splitlines()[0])
    return record


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of radius 0.1 m that stands on the ground, made longer to the right (+X)."""
    folder = tmp_path_factory.mktemp("asset")
    mesh = textured(64)
    object.__setattr__(mesh.mesh, "vertices", mesh.mesh.vertices * np.float32([2, 1, 1]))
    made = product(mesh, up=UP, metres_per_unit=0.1)
    light = np.where(latlong_directions(64) @ BRIGHT > 0.9, 5.0, 0.1)[..., None]
    around = Surroundings(
        AssetFrame.of(UP, 0.1),
        np.repeat(light, 3, axis=2).astype(np.float32),
        orbit(2),
        finished.field().geometry,
    )
    for write in writers(around, preview=64):
        write(folder, made)
    return folder


@pytest.mark.parametrize("name", ["asset.glb", "asset.usdz", "asset.usdc"])
def test_blender_gets_one_mesh_upright_in_metres_with_its_textures(name: str, folder: Path) -> None:
    found = look(folder / name)
    low, high = np.array(found["bounds"])  # Blender has z up
    np.testing.assert_allclose(low, [-0.2, -0.1, 0.0], atol=2e-4)
    np.testing.assert_allclose(high, [0.2, 0.1, 0.2], atol=2e-4)
    assert found["uv_sets"] == 1 and found["custom_normals"]
    assert {"Base Color", "Roughness", "Metallic", "Normal"} <= set(found["linked"])
    spaces = found["spaces"]
    assert spaces.pop("base_color") == "sRGB"
    assert spaces and set(spaces.values()) == {"Non-Color"}


def test_blender_makes_the_tangents_that_the_normal_map_was_baked_with(tmp_path: Path) -> None:
    """It does not read TANGENT but makes its own, of normals and texture coordinates."""
    solid = sphere(16)
    shaped = solid.vertices * (1 + 0.15 * np.sin(4 * solid.vertices).prod(1, keepdims=True))
    whole = Mesh(shaped.astype(np.float32), solid.faces)
    mesh = unwrap(whole, gutter=4 / 64, max_stretch=0.1667, timeout_s=60).mesh
    plain = textured(64)
    made = product(replace(plain, mesh=mesh, tangents=mikktspace(mesh)), up=UP, metres_per_unit=1.0)
    glb(tmp_path, made)
    found = np.array(look(tmp_path / "asset.glb", "frames")["frames"])
    vertex = found[:, 0].astype(int)
    y_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # Blender has z up
    np.testing.assert_allclose(found[:, 1:4] @ y_up, made.vertices[vertex], atol=1e-5)
    cosine = ((found[:, 4:7] @ y_up) * made.tangents[vertex, :3]).sum(1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.quantile(angle, 0.99) < 0.5 and angle.max() < 5, (angle.mean(), angle.max())
    np.testing.assert_array_equal(found[:, 7], made.tangents[vertex, 3])


def test_blender_reads_the_obj(folder: Path) -> None:
    found = look(folder / "asset.obj")
    np.testing.assert_allclose(np.ptp(found["bounds"], axis=0), [0.4, 0.2, 0.2], atol=2e-4)
    assert found["uv_sets"] == 1
    assert {"Base Color", "Roughness", "Metallic"} <= set(found["linked"])  # it knows no `norm`


def test_in_blender_the_light_comes_from_where_it_came(folder: Path) -> None:
    """The dome light of scene.usda: its lat-long layout is as another program understands it."""
    found = look(folder / "scene.usda", "0.6,0,0.8", "-0.6,0,0.8", "0.6,0,-0.8", "0,1,0")
    bright, *dark = found["light"]
    assert bright > 10 * max(dark)
    assert len(found["cameras"]) == 2
