"""The Blender add-on, without Blender. tests/export/test_addon_in_blender.py runs it there."""

import ast
import json
import os
import runpy
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from addon import BUILDER, ROOT, SOURCE, fake_program, module, shifted, wait_for
from painted import textured

from refdgs_pipe import recipe
from refdgs_pipe.cli.logs import RunLog
from refdgs_pipe.cli.workspace import default_root
from refdgs_pipe.export.files import textures, usdc
from refdgs_pipe.export.frame import AssetFrame
from refdgs_pipe.export.product import product
from refdgs_pipe.export.scene import write_scene
from refdgs_pipe.formatting import roughly
from refdgs_pipe.pipeline.events import Finished, Measured, Progress, Started

program, job, progress = module("program"), module("job"), module("progress")
workspace, cameras = module("workspace"), module("cameras")
AddonError = module("errors").AddonError
UP = np.array([0.0, 0.0, 1.0])
SOURCES = sorted(SOURCE.glob("*.py"))
HOSTILE = "a b; touch owned $(touch owned) `touch owned` 'é\" 写 & | -x"


def started(tmp_path: Path, mode: str, name: str = "photos") -> Any:
    """A run of the fake program, and the workspace that it uses."""
    photos = tmp_path / name
    photos.mkdir()
    command = program.run_command(
        fake_program(tmp_path / "bin"), program.Order(str(photos), recipe=mode)
    )
    return job.Job.start(command, workspace.root_for(str(photos), ""))


# --- the program


def test_the_program_is_found_on_the_path_in_a_folder_or_as_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = fake_program(tmp_path / "my clone é" / ".venv" / "bin")
    for chosen in (file, file.parent, file.parent.parent, tmp_path / "my clone é"):
        assert program.find(str(chosen)) == file
    monkeypatch.setenv("PATH", str(file.parent))
    assert program.find("") == file


def test_a_program_that_is_missing_is_an_error_that_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    for chosen in ("", str(tmp_path), str(tmp_path / "gone")):
        with pytest.raises(AddonError, match="preferences"):
            program.find(chosen)
    plain = tmp_path / "plain"
    plain.write_text("no program")
    with pytest.raises(AddonError, match="may not be run"):
        program.find(str(plain))
    with pytest.raises(AddonError, match="cannot be started"):
        job.Job.start([str(tmp_path / "gone"), "run"], tmp_path)


def test_a_run_without_photos_or_with_an_impossible_size_is_not_started(tmp_path: Path) -> None:
    for order in (
        program.Order(""),
        program.Order(str(tmp_path / "gone")),
        program.Order(str(tmp_path), size_m=float("nan")),
        program.Order(str(tmp_path), size_m=-1.0),
    ):
        with pytest.raises(AddonError):
            program.run_command(tmp_path, order)


def test_the_real_program_takes_the_command_that_the_add_on_builds(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"\xff\xd8")
    order = program.Order(str(tmp_path / "photos"), str(tmp_path / "work"), "preview", 0.25)
    command = program.run_command(Path("refdgs-pipe"), order)
    command[:2] = [sys.executable, "-m", "refdgs_pipe", "run", "--dry-run"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout)["settings"]["export"]["longest"] == 0.25


def test_the_known_recipes_exist_and_the_list_of_the_program_replaces_them(tmp_path: Path) -> None:
    assert {one.name for one in program.KNOWN} <= set(recipe.names())
    listed = program.recipes(fake_program(tmp_path))
    assert [(one.name, one.about) for one in listed] == [
        ("preview", "preview!"),
        ("new-one", "new-one!"),
    ]
    with pytest.raises(AddonError, match="recipes"):
        program.recipes(tmp_path / "gone")


def test_variables_of_blenders_python_do_not_reach_the_program(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PYTHONHOME", "blender")
    monkeypatch.setenv("OTHER", "stays")
    found = program.environment()
    assert "PYTHONHOME" not in found and found["OTHER"] == "stays"


# --- a run


def test_a_run_tells_its_progress_and_stops_when_asked(tmp_path: Path) -> None:
    run = started(tmp_path, "wait")
    wait_for(lambda: run.poll() is None and run.progress.label and run.progress.left)
    assert run.progress.words == "train: training, 10 of 40"
    assert run.progress.share == 0.25
    assert run.progress.left == "about 3 min left in all"
    assert os.getpgid(run.process.pid) == run.process.pid != os.getpgid(0)
    run.stop()
    ending = wait_for(run.poll)
    assert ending.code == 130 and not ending.is_error and "press Run" in ending.words
    assert (tmp_path / "photos.refdgs" / "stopped").exists()
    run.stop()  # too late, and no error
    assert run.poll() is ending


def test_a_run_that_ends_well_tells_the_verdict_and_leaves_no_file_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    run = started(tmp_path, "fine")
    ending = wait_for(run.poll)
    assert (ending.code, ending.words) == (0, "good, ready to use")
    assert ending.workspace == tmp_path / "photos.refdgs"
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize(
    ("mode", "code", "words"),
    [
        ("fail", 65, "3 photos: at least 8 are needed. Take more (exit code 65)"),
        ("usage", 2, "Error: No such option: --sizes (exit code 2)"),
        ("killed", -9, "a signal ended refdgs-pipe (9)"),
    ],
)
def test_an_error_of_the_program_is_told_with_its_exit_code(
    mode: str, code: int, words: str, tmp_path: Path
) -> None:
    ending = wait_for(started(tmp_path, mode).poll)
    assert ending.code == code and ending.is_error and ending.words.startswith(words)


def test_an_error_of_the_real_program_is_told_in_its_own_sentence(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    command = [sys.executable, "-m", "refdgs_pipe", "run", "--json", "--", str(tmp_path / "photos")]
    ending = wait_for(job.Job.start(command, tmp_path / "photos.refdgs").poll, 120)
    assert ending.code == 65 and "photos" in ending.message and "\n" not in ending.message


def test_no_shell_reads_the_name_of_a_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = started(tmp_path, "fine", HOSTILE)
    assert wait_for(run.poll).code == 0
    arguments = json.loads((tmp_path / f"{HOSTILE}.refdgs" / "argv.json").read_text())
    assert arguments[-2:] == ["--", str(tmp_path / HOSTILE)]
    assert list(tmp_path.rglob("owned")) == []


# --- its progress


def test_the_log_that_the_real_program_writes_is_understood(tmp_path: Path) -> None:
    log = RunLog(tmp_path)
    tail = progress.Tail(log.path)
    now = progress.Progress(left="about 9 min left in all")
    seen = []
    for event in (
        Started("train", "never run"),
        Progress("train", "training", 1, 4, work=0.1),
        Measured("train", "steps", 4),
        Finished("train", 2.0),
    ):
        log(event)
        for line in tail.lines():
            now = progress.after_event(now, line)
        seen.append((now.words, now.share))
    log.close()
    assert seen == [
        ("train", None),
        ("train: training, 1 of 4", 0.1),
        ("train: training, 1 of 4", 0.1),
        ("starting", None),
    ]
    assert now.left == "about 9 min left in all"


def test_the_time_left_is_read_from_the_programs_words() -> None:
    for seconds in (3, 40, 200, 3000, 90000):
        line = f"train: training 1/4, loss 0.1, {roughly(seconds)} left in this part"
        now = progress.after_words(progress.Progress(told="before"), line)
        assert now.left == f"{roughly(seconds)} left in this part" and now.told == "before"
    later = progress.after_event(now, json.dumps({"event": "started", "stage": "shape"}))
    assert later.left == ""  # the part is over


@pytest.mark.parametrize(
    "line",
    ["", "{", "[]", "7", '{"event": "progress", "done": "x"}', '{"event": 1}', "[" * 100_000],
)
def test_a_line_that_is_no_event_changes_nothing(line: str) -> None:
    now = progress.Progress("train", "training", 1, 4)
    assert progress.after_event(now, line) == now


def test_a_line_is_read_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "log"
    tail = progress.Tail(path)
    assert tail.lines() == []
    path.write_bytes("one\ntwö".encode()[:-1])
    assert tail.lines() == ["one"]
    with path.open("ab") as file:
        file.write("ö".encode()[1:] + b"\n")
    assert tail.lines() == ["twö"]


def test_the_log_of_this_run_is_taken(tmp_path: Path) -> None:
    for name in ("20260101-000000-7.jsonl", "20260102-000000-9.jsonl", "20260103-000000-8.jsonl"):
        (tmp_path / name).touch()
    (tmp_path / "20260104-000000-7.jsonl").symlink_to(tmp_path / "elsewhere")
    none: frozenset[str] = frozenset()
    assert progress.log_of(tmp_path, 7, none) == tmp_path / "20260101-000000-7.jsonl"
    assert progress.log_of(tmp_path, 5, none) == tmp_path / "20260103-000000-8.jsonl"
    assert progress.log_of(tmp_path, 7, progress.names_of(tmp_path)) is None
    assert progress.log_of(tmp_path / "gone", 7, none) is None


# --- its workspace


def test_the_workspace_is_the_one_that_the_program_takes(tmp_path: Path) -> None:
    folder, packed, video = tmp_path / "my photos", tmp_path / "some.zip", tmp_path / "film.mp4"
    folder.mkdir()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("a.jpg", b"\xff\xd8")
    video.write_bytes(b"\0\0\0\x18ftypmp42" + bytes(64))
    for photos in (folder, packed, video, tmp_path / "x" / ".." / "my photos"):
        assert workspace.root_for(str(photos), "") == default_root([photos])
    assert workspace.root_for("anything", str(tmp_path / "w")) == tmp_path / "w"
    (folder / "workspace.json").write_text("{}")
    assert workspace.root_for(str(folder), "") == folder
    for photos in ("", "/"):
        with pytest.raises(AddonError):
            workspace.root_for(photos, "")


def test_a_workspace_without_an_asset_is_refused_and_no_link_is_followed(tmp_path: Path) -> None:
    root = tmp_path / "cup.refdgs"
    with pytest.raises(AddonError, match="no such workspace"):
        workspace.asset_of(root)
    (root / "asset").mkdir(parents=True)
    (tmp_path / "secret").write_bytes(b"glTF")
    (root / "asset" / "asset.glb").symlink_to(tmp_path / "secret")
    with pytest.raises(AddonError, match=r"asset\.glb is not there"):
        workspace.asset_of(root)
    (root / "asset" / "asset.glb").unlink()
    (root / "asset" / "asset.glb").write_bytes(b"glTF")
    found = workspace.asset_of(root)
    assert (found.name, found.light, found.scene) == ("cup", None, None)


def test_photos_are_found_by_the_names_of_cameras_and_only_inside_their_folder(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "ingest" / "0123456789abcdef"
    (folder / "images").mkdir(parents=True)
    (tmp_path / "ingest" / ".current").write_text("0123456789abcdef\n")
    (tmp_path / "out.png").touch()
    for name in ("1 é", "a-b", "a_b"):
        (folder / "images" / f"{name}.png").touch()
    names = {"1 é": "images/1 é.png", "a-b": "images/a-b.png", "a_b": "images/a_b.png"}
    names |= {"out": "../../out.png", "gone": "images/gone.png", "root": str(tmp_path / "out.png")}
    views = [{"name": n, "file": f, "width": 4, "height": 3} for n, f in names.items()]
    (folder / "views.json").write_text(json.dumps({"views": [*views, {"name": "bad"}, 7]}))
    found = workspace.pictures(tmp_path)
    assert {name: one.name for name, one in found.items()} == {"____": "1 é"}
    assert workspace.pictures(folder) == {}


def test_cameras_are_named_as_usd_names_them() -> None:
    from pxr import Tf

    for name in ("IMG_0001", "1 é", "写真-3", "", "_x.y", "a b/c", "9"):
        assert workspace.camera_name(name) == Tf.MakeValidIdentifier(name)


# --- its cameras


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene with two cameras whose axes do not pass through the middle of their pictures."""
    made = product(textured(16), up=UP, metres_per_unit=0.1)
    for write in (textures, usdc):
        write(tmp_path, made)
    write_scene(tmp_path, shifted(), AssetFrame.of(UP, 0.1), made.about)
    return tmp_path / "scene.usda"


def test_a_camera_of_a_photo_sees_a_point_where_the_photo_has_it(scene: Path) -> None:
    """By the formulas of Blender's manual; test_addon_in_blender.py asks Blender itself."""
    frame = AssetFrame.of(UP, 0.1)
    points = np.array([[0.3, -0.2, 0.5], [-0.4, 0.1, 0.0], [0.0, 0.6, -0.3]])
    blender = frame.points(points) @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    for found, camera in zip(cameras.read_cameras(scene), shifted(), strict=True):
        pose = np.array(found.pose)
        local = (blender - pose[:3, 3]) @ pose[:3, :3]
        film = local[:, :2] / -local[:, 2:] * found.lens_mm / cameras.FILM_MM
        right, up = film[:, 0] - found.shift_x, film[:, 1] - found.shift_y
        pixels = np.stack([(right + 0.5) * camera.width, -up * camera.width + camera.height / 2], 1)
        np.testing.assert_allclose(pixels, camera.project(points)[0], atol=1e-3)  # USD has floats
        assert found.aspect == pytest.approx(camera.height / camera.width)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("#usda 1.0", "#usda 9"),
        ("float focalLength = ", "float focalLength = nan #"),
        ("float horizontalAperture = ", "float horizontalAperture = -"),
        ("matrix4d xformOp:transform = ((", "matrix4d xformOp:transform = ((5, "),
        ("matrix4d xformOp:transform", "matrix4d other"),
    ],
)
def test_a_damaged_scene_is_an_error(old: str, new: str, scene: Path) -> None:
    text = scene.read_text().replace("( (", "((")
    assert old in text
    scene.write_text(text.replace(old, new))
    with pytest.raises(AddonError, match="Run again"):
        cameras.read_cameras(scene)


# --- the add-on as a whole


def test_the_zip_has_equal_bytes_each_time_and_all_that_blender_asks_for(tmp_path: Path) -> None:
    build = runpy.run_path(str(BUILDER))["build"]
    first, second = build(tmp_path / "a"), build(tmp_path / "b")
    assert first.name == "refdgs_pipe_blender-0.1.0.zip"
    assert first.read_bytes() == second.read_bytes()
    with zipfile.ZipFile(first) as archive:
        names = archive.namelist()
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert {"__init__.py", "blender_manifest.toml", "LICENSE"} <= set(names)
    assert {path.name for path in SOURCES} <= set(names)
    assert manifest["license"] == ["SPDX:Apache-2.0"] and manifest["type"] == "add-on"
    assert len(manifest["tagline"]) <= 64 and len(manifest["permissions"]["files"]) <= 64
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert manifest["version"] == project["version"]


def test_the_add_on_needs_only_pythons_own_library_and_blender() -> None:
    allowed = {*sys.stdlib_module_names, "bpy", "mathutils"}
    forbidden = {"pickle", "marshal", "shelve", "ctypes"}
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and not node.level:
                names = [node.module or ""]
            tops = {name.partition(".")[0] for name in names}
            assert tops <= allowed - forbidden, path.name
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in ("eval", "exec", "os.system", "os.popen"), path.name
                assert all(word.arg != "shell" for word in node.keywords), path.name


def test_the_add_on_keeps_to_the_sizes_and_docstrings_of_the_project() -> None:
    for path in [*SOURCES, BUILDER]:
        text = path.read_text("utf-8")
        assert len(text.splitlines()) <= 400, path.name
        assert ast.get_docstring(ast.parse(text)), path.name
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                assert (node.end_lineno or 0) - node.lineno < 60, node.name
                assert node.name.startswith("_") or ast.get_docstring(node), node.name


def test_ci_builds_the_add_on() -> None:
    assert "examples/blender/build.py" in (ROOT / ".ci" / "run").read_text("utf-8")
