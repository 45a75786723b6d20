"""The product as its user meets it: a capture in, an asset out, from the real command line.

The settings are far too small for a good result; they run every stage in seconds.
"""

import json
import os
import random
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scenes import glossy_pair, orbit

from refdgs_pipe.cli.app import app
from refdgs_pipe.reporting import asset as turntable

SMALL = {
    "train.iterations": 40,
    "start.volume_steps": 20,
    "start.surfels": 1500,
    "train.max_surfels": 2000,
    "start.local_surfels": 500,
    "train.max_local_surfels": 600,
    "train.environment_height": 16,
    "extract.voxel": 0.02,
    "extract.pixels": 128,
    "clean.faces": 2000,
    "appearance.samples": 5000,
    "appearance.light": 16,
    "bake.size": 128,
    "export.preview": 64,
}
FILES = {"asset.glb", "asset.usdz", "asset.usdc", "asset.obj", "splats.ply", "preview.png"}


def write_capture(folder: Path, *, count: int = 24, size: int = 64) -> Path:
    """A data set with known poses of the procedural scene: every fourth view held out.

    The true normals of held-out views are there, and no other truth.
    """
    scene, frames = glossy_pair(), {"train": list[Any](), "test": list[Any]()}
    for i, camera in enumerate(orbit(count, size=size, focal=size * 1.4)):
        maps = scene.surface_map(camera)
        split = "test" if i % 4 == 3 else "train"
        rgba = np.concatenate([maps.color, maps.alpha[..., None]], -1)
        (folder / split).mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.round(rgba * 255).astype(np.uint8)).save(folder / split / f"r_{i}.png")
        if split == "test":
            code = np.concatenate([maps.normal / 2 + 0.5, maps.alpha[..., None]], -1)
            truth = Image.fromarray(np.round(code * 255).astype(np.uint8))
            truth.save(folder / split / f"r_{i}_normal.png")
        pose = camera.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
        record = {"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()}
        frames[split].append(record)
    angle = 2 * np.arctan(0.5 / 1.4)
    for split, records in frames.items():
        text = json.dumps({"camera_angle_x": angle, "frames": records})
        (folder / f"transforms_{split}.json").write_text(text)
    return folder


def sets(settings: dict[str, Any]) -> list[str]:
    """The small settings and these, as options."""
    chosen = SMALL | {key.replace("__", "."): value for key, value in settings.items()}
    return [part for item in chosen.items() for part in ("--set", "{}={}".format(*item))]


def start(*arguments: str, **settings: Any) -> subprocess.Popen[str]:
    paths = os.pathsep.join(path for path in sys.path if path)
    return subprocess.Popen(
        [sys.executable, "-m", "refdgs_pipe.cli.app", *arguments, *sets(settings)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
    )


def run(*arguments: str, **settings: Any) -> Any:
    process = start(*arguments, "--json", **settings)
    out, err = process.communicate()
    assert process.returncode == 0, out + err
    return json.loads(out)


def digests(record: Any) -> dict[str, str]:
    """The content of every result."""
    folders = {stage["stage"]: Path(stage["folder"]) for stage in record["stages"]}
    return {
        name: json.loads((folders[name] / "manifest.json").read_text())["digest"]
        for name in folders
    }


@pytest.fixture
def here(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Runs the command line in this process, with a small report: what `run` prints."""
    monkeypatch.setattr(turntable, "_FRAME", 40)
    monkeypatch.setattr(turntable, "_CLOSE_UP", 40)

    def call(*arguments: str, **settings: Any) -> Any:
        words = ["run", *arguments, "--json", *sets(settings)]
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            app(words, prog_name="refdgs-pipe")
        assert not ended.value.code
        return json.loads(capsys.readouterr().out)

    return call


def to_make(plan: Any) -> list[str]:
    """The stages that a run would make."""
    return [stage["stage"] for stage in plan["stages"] if stage["state"] != "up to date"]


def test_a_capture_becomes_an_asset_and_only_what_changed_is_made_again(
    tmp_path: Path, here: Callable[..., Any]
) -> None:
    photos = str(write_capture(tmp_path / "photos", count=16))
    record = run("run", photos)
    asset = tmp_path / "photos.refdgs" / "asset"
    assert record["asset"] == str(asset)
    assert set(record["files"]) >= FILES
    magic, version, length = struct.unpack("<4sII", (asset / "asset.glb").read_bytes()[:12])
    assert (magic, version) == (b"glTF", 2)
    assert length == record["files"]["asset.glb"]
    assert (asset / "asset.usdz").read_bytes()[:2] == b"PK"
    assert run("run", photos)["made"] == []
    check_scores(tmp_path / "photos.refdgs")
    (tmp_path / "photos" / "test" / "r_3_normal.png").unlink()
    assert here(photos)["made"] == ["ingest", "evaluate"]  # truth is no photo
    followers = ["extract", "clean", "fit", "appearance", "unwrap", "bake", "export"]
    again = here(photos, extract__voxel=0.025)["made"]
    assert [name for name in again if name != "evaluate"] == followers
    again = to_make(here(photos, "--dry-run", fit__outlines=1))
    assert [name for name in again if name != "evaluate"] == followers[2:]
    plan = here(photos, "--dry-run", "--until", "refine", refine__surfels=1.2)
    assert to_make(plan) == ["refine"]
    assert here(photos)["made"] == []


def check_scores(work: Path) -> None:
    """`eval` uses the scores that the run has made, and tells them to people and programs."""
    scored = subprocess.run(
        [sys.executable, "-m", "refdgs_pipe.cli.app", "eval", str(work), "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "done in" not in scored.stderr  # nothing is made again
    record = json.loads(scored.stdout)
    assert record["scores"]["split"] == "test" and len(record["scores"]["views"]) == 4
    assert record["scores"]["mean"]["psnr"] > 5
    assert 0 < record["scores"]["mean"]["normal_mae_deg"] < 90
    assert record["scores"]["mean"]["depth_mae"] is None
    assert record["scores"]["notes"]["surface"] == "no gt_mesh.ply in the data set"
    assert record["speed"]["views_per_second"] > 0
    assert set(record["seconds"]) >= {"ingest", "train", "clean", "fit", "evaluate", "export"}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_killed_at_50_random_moments_the_real_pipeline_ends_with_the_same_result(
    tmp_path: Path,
) -> None:
    photos = str(write_capture(tmp_path / "photos"))
    work = str(tmp_path / "work")
    begun = time.monotonic()
    undisturbed = run("run", photos, "-w", str(tmp_path / "undisturbed"))
    whole_s = time.monotonic() - begun
    chance = random.Random(0)
    options: list[str] = []
    for _ in range(50):
        process = start("run", photos, "-w", work, *options)
        options = []
        try:
            process.communicate(timeout=0.5 + chance.random() * whole_s / 3)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
        else:  # it came to the end: let the next one begin with some stage again
            assert process.returncode == 0
            options = ["--from", chance.choice(list(digests(undisturbed)))]
    last = run("run", photos, "-w", work)
    assert digests(last) == digests(undisturbed)
    assert set(last["files"]) == set(undisturbed["files"])
    assert run("run", photos, "-w", work)["made"] == []
