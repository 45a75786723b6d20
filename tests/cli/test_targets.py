"""Delivery targets on the command line."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from refdgs_pipe.artifacts.asset import Asset, Delivery
from refdgs_pipe.cli.app import app
from refdgs_pipe.cli.closing import closing
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.errors import InputError
from refdgs_pipe.export.settings import ExportParams


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    for i in range(3):
        picture = np.random.default_rng(i).integers(0, 255, (96, 128, 3)).astype(np.uint8)
        cv2.imwrite(str(folder / f"{i}.png"), picture)
    return folder


def test_an_unknown_target_is_refused_at_once_with_the_names_there_are(
    photos: Path, tmp_path: Path
) -> None:
    arguments = ["run", str(photos), "--dry-run", "--set", "export.targets=[web, vr]"]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, InputError) and result.exception.exit_code == 64
    said = str(result.exception)
    assert "--set export.targets=[web, vr]" in said and '"vr"' in said
    assert all(name in said for name in ("web", "ar", "game", "film", "print"))
    assert not (tmp_path / "photos.refdgs").exists()


@pytest.mark.parametrize("given", ["web,game", "[web, game]", "web game web", ("web", "game")])
def test_targets_need_no_quotes_and_count_once(given: object) -> None:
    assert ExportParams(targets=given).targets == ("web", "game")


def test_targets_are_a_setting_of_the_export_and_none_is_the_default() -> None:
    result = CliRunner().invoke(app, ["recipe", "show", "glossy", "--resolved"])
    assert "targets = []" in result.stdout.partition("[export]")[2]


def test_the_end_of_a_run_says_which_file_is_for_what(tmp_path: Path) -> None:
    names = ("asset.glb", "targets/web/asset.glb", "targets/game/asset_lod0.glb")
    names += ("targets/game/asset_lod1.glb", "targets/game/textures/normal.png")
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"x" * 2000)
    made = (
        Delivery("web", names[1:2], "9000 triangles", {}),
        Delivery("game", names[2:], "LODs of 50000 and 15000 triangles", {}),
    )
    Asset.of(tmp_path, faces=1, texture_size=1, targets=made).save(tmp_path)
    record = {"asset": str(tmp_path), "files": dict.fromkeys(names, 2000), "size": None}
    record |= {"made": [], "warnings": [], "report": None, "seconds": 1.0, "report_seconds": 0.0}
    said = closing(Workspace.__new__(Workspace), record, [], None)
    lines = [" ".join(line.split()) for line in said]
    assert "web targets/web/asset.glb 2.0 kB 9000 triangles" in lines
    assert "game targets/game/asset_lod0.glb 2.0 kB LODs of 50000 and 15000 triangles" in lines
    assert "targets/game/asset_lod1.glb 2.0 kB" in lines
    assert not any("normal.png" in line or "more" in line for line in lines)
