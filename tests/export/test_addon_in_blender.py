"""The Blender add-on in Blender: run with  pytest -m dcc, BPY_PYTHON naming a Python with bpy."""

import json
import os
import runpy
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import cv2
import finished
import numpy as np
import pytest
from addon import BUILDER, fake_program, shifted
from painted import textured

from refdgs_pipe.export.files import Surroundings, writers
from refdgs_pipe.export.frame import AssetFrame, latlong_directions
from refdgs_pipe.export.product import product

pytestmark = pytest.mark.dcc
UP = np.array([0.0, 0.0, 1.0])
FRAME = AssetFrame.of(UP, 0.1)
SCRIPT = Path(__file__).parent / "addon_in_blender.py"
NAME = "my cup é"  # of the folder of photos


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished workspace. Its light has the colour (1 + direction) / 2 in each direction."""
    root = tmp_path_factory.mktemp("work") / f"{NAME}.refdgs"
    mesh = textured(64)
    object.__setattr__(mesh.mesh, "vertices", mesh.mesh.vertices * np.float32([2, 1, 1]))
    light = (0.5 + 0.5 * latlong_directions(64)).astype(np.float32)
    around = Surroundings(FRAME, light, shifted(), finished.field().geometry)
    (root / "asset").mkdir(parents=True)
    made = product(mesh, up=UP, metres_per_unit=0.1)
    for write in writers(around, preview=64):
        write(root / "asset", made)
    pictures = root / "ingest" / "0123456789abcdef"
    (pictures / "images").mkdir(parents=True)
    (root / "ingest" / ".current").write_text(pictures.name)
    records = []
    for camera in shifted():
        file = f"images/{camera.name}.png"
        done = cv2.imwrite(
            str(pictures / file), np.zeros((camera.height, camera.width, 3), np.uint8)
        )
        assert done
        size = {"width": camera.width, "height": camera.height}
        records.append({"name": camera.name, "file": file, **size})
    (pictures / "views.json").write_text(json.dumps({"views": records}))
    return root


def blender(tmp_path: Path, **tasks: Any) -> dict[str, Any]:
    """What addon_in_blender.py tells about these tasks."""
    archive = runpy.run_path(str(BUILDER))["build"](tmp_path)
    (tmp_path / "photos é").mkdir()
    given = {
        "program": str(fake_program(tmp_path / "my bin é")),
        "photos": str(tmp_path / "photos é"),
        "workspace": "",
    }
    file = tmp_path / "tasks.json"
    file.write_text(json.dumps(given | tasks), "utf-8")
    python, program = os.environ.get("BPY_PYTHON"), shutil.which("blender")
    if python:
        command = [python, str(SCRIPT), str(archive), str(file)]
    elif program:
        options = ["--background", "--factory-startup", "--python-exit-code", "3", "--python"]
        command = [program, *options, str(SCRIPT), "--", str(archive), str(file)]
    else:
        pytest.skip("no Blender: set BPY_PYTHON, or have blender on the PATH")
    surroundings = os.environ | {"BLENDER_USER_RESOURCES": str(tmp_path / "blender")}
    run = subprocess.run(command, capture_output=True, text=True, timeout=240, env=surroundings)
    assert "\nRECORD " in run.stdout, run.stdout + run.stderr
    record: dict[str, Any] = json.loads(run.stdout.rpartition("RECORD ")[2].splitlines()[0])
    return record


def test_asset_light_and_cameras_arrive_in_one_frame(root: Path, tmp_path: Path) -> None:
    sides = [[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1], [0.6, 0.64, 0.48], [0.48, -0.64, -0.6]]
    sizes = {camera.name: [camera.width, camera.height] for camera in shifted()}
    tasks = {"workspace": str(root), "bring_in": True, "directions": sides, "sizes": sizes}
    record = blender(tmp_path, **tasks)
    found = record["import"]
    assert found["pressed"] == "FINISHED" and found["error"] == ""
    assert found["result"] == f"Imported from {NAME}.refdgs: asset, light, 2 cameras"
    # objects: in the collections of the workspace, and nowhere else
    assert [kind.partition(" ")[0] for kind in found["collections"][NAME]] == ["MESH"]
    assert found["collections"][f"{NAME} cameras"] == ["CAMERA v000", "CAMERA v001"]
    assert found["camera"] == "v000" and found["picture"] == [200, 160]
    assert found["behind"] == {"v000": ["v000.png"], "v001": ["v001.png"]}
    # size and place of the mesh: Blender has z up
    low, high = np.array(found["bounds"])
    np.testing.assert_allclose(low, [-0.2, -0.1, 0.0], atol=2e-4)
    np.testing.assert_allclose(high, [0.2, 0.1, 0.2], atol=2e-4)
    # cameras: a corner of the mesh is where the photo has it; GLB and USD have 32 bits
    world = (np.array(found["corners"]) @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ FRAME.turn / 0.1
    for camera in shifted():
        np.testing.assert_allclose(
            found["pixels"][camera.name], camera.project(world)[0], atol=0.02, err_msg=camera.name
        )
    # light: its colour tells the direction; RGBE has 8 bits, and the camera sees 0.3 rad
    expected = 0.5 + 0.5 * np.array(sides)
    np.testing.assert_allclose(record["light"], expected, atol=0.02)


def test_a_run_in_blender_shows_progress_and_its_verdict(tmp_path: Path) -> None:
    found = blender(tmp_path, run=["preview", 0.25])["run"]
    assert found["pressed"] == "FINISHED" and found["ticking"]
    assert "poll() failed" in found["second"]  # one run at a time
    assert found["error"] == "" and found["result"] == "good, ready to use"
    fields = {"Photos", "Workspace", "Recipe", "Longest side", "Asset", "Light", "Cameras"}
    buttons = {"refdgs_pipe.run", "refdgs_pipe.stop", "refdgs_pipe.bring_in"}
    assert fields | buttons | {"good, ready to use"} <= set(found["drawn"])
    assert set(found["drawn"]) & set(found["words"])  # how far it was
    arguments = json.loads((tmp_path / "photos é.refdgs" / "argv.json").read_text())
    photos = str(tmp_path / "photos é")
    assert arguments == ["run", "--json", "--recipe", "preview", "--size", "0.25", "--", photos]


def test_errors_are_reported_and_kept_for_the_panel(tmp_path: Path) -> None:
    record = blender(tmp_path, program=str(tmp_path), run=["REMEMBERED", 0.0], bring_in=True)
    assert "preferences" in record["run"]["pressed"] and "preferences" in record["run"]["error"]
    assert "there is no such workspace" in record["import"]["pressed"]
    assert "there is no such workspace" in record["import"]["error"]
    assert record["import"]["collections"] == {}


@pytest.mark.parametrize("how", ["stop", "close"])
def test_stop_and_the_end_of_blender_stop_the_run_cleanly(how: str, tmp_path: Path) -> None:
    program = fake_program(tmp_path / "waiting")  # with no recipe it waits for a signal
    text = program.read_text("utf-8").replace('"--recipe", "fine"', '"--recipe", "wait"')
    program.write_text(text, "utf-8")
    tasks: dict[str, Any] = {"program": str(program), "run": ["REMEMBERED", 0.0], how: True}
    found = blender(tmp_path, **tasks)["run"]
    assert "train: training, 10 of 40" in found["words"]
    stopped, end = tmp_path / "photos é.refdgs" / "stopped", time.monotonic() + 20
    while not stopped.exists() and time.monotonic() < end:
        time.sleep(0.05)
    assert stopped.exists()
    if how == "stop":
        assert found["error"] == "" and found["result"].startswith("stopped")
