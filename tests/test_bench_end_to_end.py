"""A bench of the real pipeline over GlossySynthetic as published, too short for good figures."""

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scenes import glossy_pair, orbit
from test_end_to_end import SMALL

from refdgs_pipe.files.images import write_png


def write_nero(folder: Path, *, count: int = 24, size: int = 64) -> None:
    """The procedural scene as NeRO publishes its scenes."""
    folder.mkdir()
    scene = glossy_pair()
    for i, camera in enumerate(orbit(count, size=size, focal=size * 1.4)):
        maps = scene.surface_map(camera)
        picture = maps.color + (1 - maps.alpha[..., None])
        Image.fromarray(np.round(picture.clip(0, 1) * 255).astype(np.uint8)).save(
            folder / f"{i}.png"
        )
        depth = np.where(maps.alpha > 0.5, maps.depth, 15.0) / 15 * 65535
        write_png(folder / f"{i}-depth.png", np.round(depth).astype(np.uint16))
        camera_file = folder / f"{i}-camera.pkl"
        camera_file.write_bytes(pickle.dumps((camera.cam_from_world[:3], camera.K)))


def bench(folder: Path, *arguments: str) -> Any:
    sets = [part for item in SMALL.items() for part in ("--set", "{}={}".format(*item))]
    command = [sys.executable, "-m", "refdgs_pipe.cli.app", "bench", *arguments, *sets]
    paths = os.pathsep.join(path for path in sys.path if path)
    result = subprocess.run(
        [*command, "--out", str(folder / "out"), "--json"],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": paths},
    )
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.slow
def test_a_glossy_synthetic_scene_is_trained_scored_and_tabled(tmp_path: Path) -> None:
    write_nero(tmp_path / "bell")
    record = bench(tmp_path, str(tmp_path / "bell"), "--seeds", "0,1")
    first, second = record["cells"]
    assert first["figures"]["psnr"] > 8 and first["figures"]["psnr"] != second["figures"]["psnr"]
    assert 0 < first["train_s"] < first["total_s"]
    views = tmp_path / "out" / "bell-glossy-s0.refdgs" / "ingest"
    (listed,) = views.glob("*/views.json")
    tests = [v["source"] for v in json.loads(listed.read_text())["views"] if v["split"] == "test"]
    assert tests == [f"{i}.png" for i in (0, 2, 3, 4, 5, 7, 11, 14, 19)]
    again = bench(tmp_path, str(tmp_path / "bell"), "--seeds", "0,1")
    assert again == record  # nothing was made again
    table = (tmp_path / "out" / "bench.md").read_text()
    assert "| bell | glossy | 0 |" in table and "depth_mae" in table
