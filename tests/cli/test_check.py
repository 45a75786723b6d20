"""`check` says in words and as JSON what photos are good for, and writes one page beside them."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from captures import EXAMPLE, write_photos
from test_end_to_end import write_capture

from refdgs_pipe.cli.app import app

KEYS = {
    "schema",
    "verdict",
    "line",
    "to_do",
    "exit_code",
    "is_preliminary",
    "findings",
    "photos",
    "skipped",
    "warnings",
    "known_poses",
    "placement",
    "coverage",
    "costs",
    "seconds",
    "page",
}


def check(*arguments: str | Path) -> int:
    """Run the command in this process; its exit code."""
    with pytest.raises(SystemExit) as end:
        app(["check", *map(str, arguments), "--threads", "1", "-q"], prog_name="refdgs-pipe")
    assert isinstance(end.value.code, int)
    return end.value.code


@pytest.fixture(scope="module")
def kettle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some neighbouring photos of the example, one damaged file and a note among them."""
    folder = tmp_path_factory.mktemp("photos") / "kettle"
    folder.mkdir()
    for path in sorted(EXAMPLE.glob("*.jpg"))[:5]:
        shutil.copy(path, folder)
    (folder / "IMG_9000.jpg").write_bytes(b"\xff\xd8\xff\xe0 and no more")
    (folder / "notes.txt").write_text("taken in May")
    return folder


def test_photos_are_looked_at_and_left_alone(
    kettle: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(kettle.iterdir())
    code = check(kettle, "--json")
    record: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert set(record) == KEYS
    assert code == record["exit_code"] == {"but": 0, "unclear": 66}[record["verdict"]]
    assert len(record["photos"]) == record["placement"]["tried"] == 5
    assert [file["name"] for file in record["skipped"] if not file["harmless"]] == ["IMG_9000.jpg"]
    names = [finding["name"] for finding in record["findings"]]
    assert names[0] == "photos" and {"sharpness", "light", "masks", "placement", "size"} <= {*names}
    assert record["placement"]["checks"][0]["name"] == "photos with a trusted place"
    assert {cost["recipe"] for cost in record["costs"]} >= {"glossy", "matte", "preview"}
    assert sorted(kettle.iterdir()) == before
    page = kettle.with_name("kettle.check.html")
    assert record["page"] == str(page)
    text = page.read_text("utf-8")
    assert record["line"] in text
    assert "could not be shown" not in text and text.count('<figure class="photo') == 5
    assert not kettle.with_name("kettle.refdgs").exists()


def test_known_poses_are_said_and_not_looked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, page = write_capture(tmp_path / "ball"), tmp_path / "elsewhere.html"
    assert check(scene, "--out", page) == 0
    said = capsys.readouterr().out
    assert said.startswith("These photos can be used")
    assert "24 poses came with the photos" in said
    assert "of this machine's cores" in said and "preview" in said
    assert page.is_file() and not (tmp_path / "ball.check.html").exists()


def test_photos_that_cannot_be_read_end_with_65_and_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path / "photos"
    for path in write_photos(photos, 4):
        path.write_bytes(path.read_bytes()[:40])
    assert check(photos, "--json") == 65
    record = json.loads(capsys.readouterr().out)
    assert set(record) == KEYS
    assert record["verdict"] == "no" and record["costs"] == [] and record["placement"] is None
    assert "usable photos" in record["findings"][0]["text"]
    assert "cannot be used" in (tmp_path / "photos.check.html").read_text("utf-8")


@pytest.mark.parametrize("name", ["empty", "nowhere"])
def test_a_folder_without_photos_is_an_error_without_a_page(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from refdgs_pipe.cli.app import main

    (tmp_path / "empty").mkdir()
    monkeypatch.setattr("sys.argv", ["refdgs-pipe", "check", str(tmp_path / name), "--json"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 65
    assert json.loads(capsys.readouterr().out)["kind"] == "CaptureError"
    assert [path.name for path in tmp_path.iterdir()] == ["empty"]


def test_a_page_among_the_photos_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from refdgs_pipe.cli.app import main

    photos = tmp_path / "photos"
    write_photos(photos, 3)
    out = photos / "page.html"
    monkeypatch.setattr("sys.argv", ["refdgs-pipe", "check", str(photos), "--out", str(out)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 64
    assert "lies among the photos" in capsys.readouterr().err
    assert not out.exists()
