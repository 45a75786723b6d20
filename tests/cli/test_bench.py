"""A grid of scenes, recipes and seeds over small stages: its figures, failures and resuming."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from forking import Forked

FAKE_CLI = Path(__file__).parent.parent / "fake_cli.py"


class Bench:
    """Runs `refdgs-pipe bench` in a folder with two scenes."""

    def __init__(self, root: Path) -> None:
        self.root, self.out = root, root / "out"
        self.scene("ball", "hello")
        self.scene("cup", "hello world")
        (root / "loud.toml").write_text('# Loud.\n[train]\nmood = "loud"\n')

    def scene(self, name: str, text: str) -> None:
        (self.root / name).mkdir(parents=True, exist_ok=True)
        (self.root / name / "a.txt").write_text(text)

    def start(self, *arguments: str, **environment: str) -> Forked:
        changes = {"COLUMNS": "100", "FAKE_BENCH": "1"} | environment
        return Forked([str(FAKE_CLI), "bench", *arguments], self.root, os.environ | changes)

    def __call__(self, *arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
        process = self.start(*arguments, "--out", "out")
        stdout, stderr = process.communicate(timeout=60)
        assert process.returncode == code, stdout + stderr
        assert "Traceback" not in stdout + stderr
        return subprocess.CompletedProcess(process.args, process.returncode, stdout, stderr)

    def record(self) -> Any:
        return json.loads((self.out / "bench.json").read_text())

    def cells(self) -> dict[str, Any]:
        return {cell["workspace"].removesuffix(".refdgs"): cell for cell in self.record()["cells"]}

    def made(self) -> dict[Path, int]:
        """When each result was written."""
        return {path: path.stat().st_mtime_ns for path in self.out.rglob("manifest.json")}


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_every_cell_has_its_figures_and_times(bench: Bench) -> None:
    result = bench("ball", "cup", "--recipes", "glossy,loud.toml", "--seeds", "0,1")
    assert result.stdout == f"{bench.out / 'bench.md'}\n"
    assert "[8/8] cup-loud-s1.refdgs" in result.stderr
    assert "8 of 8 cells finished" in result.stderr
    cells = bench.cells()
    assert len(cells) == 8
    cell = cells["cup-glossy-s1"]
    assert [cell[key] for key in ("scene", "recipe", "seed")] == ["cup", "glossy", 1]
    assert cell["status"] == "done"
    assert cell["figures"] == {"psnr": 33.0, "surface.chamfer": 0.25}
    assert set(cell["seconds"]) == {"read", "start", "train", "evaluate"}
    assert cell["train_s"] == cell["seconds"]["start"] + cell["seconds"]["train"]
    assert cell["total_s"] == pytest.approx(sum(cell["seconds"].values()))
    assert (bench.out / "cup-glossy-s1.refdgs" / "workspace.json").is_file()


def test_means_are_over_seeds_and_then_over_scenes(bench: Bench) -> None:
    bench("ball", "cup", "--recipes", "glossy,loud.toml", "--seeds", "0,1")
    record = bench.record()
    scenes = {(m["scene"], m["recipe"]): m for m in record["scenes"]}
    assert scenes["ball", "glossy"]["figures"]["psnr"] == 26.5
    assert scenes["ball", "glossy"]["figures"]["surface.chamfer"] == 0.375
    recipes = {m["recipe"]: m for m in record["recipes"]}
    assert recipes["loud"]["figures"]["psnr"] == (26.5 + 32.5) / 2
    assert (recipes["loud"]["done"], recipes["loud"]["of"]) == (2, 2)


def test_the_table_is_plain_markdown(bench: Bench) -> None:
    bench("ball", "--seeds", "0,1")
    lines = (bench.out / "bench.md").read_text().splitlines()
    assert lines[0] == "# Bench"
    assert (
        lines[2] == "| scene | recipe | seed | psnr | surface.chamfer | train_s | total_s | note |"
    )
    assert lines[4].startswith("| ball | glossy | 0 | 26 | 0.5 | ")
    assert "| ball | glossy | 2 of 2 | 26.5 | 0.375 | " in "\n".join(lines)
    tables = [line.count("|") for line in lines if line.startswith("|")]
    assert tables == [9] * 4 + [8] * 3 + [7] * 3


def test_a_second_call_makes_nothing_again_and_a_larger_grid_only_what_is_new(
    bench: Bench,
) -> None:
    bench("ball", "--seeds", "0")
    first = bench.made()
    said = bench("ball", "--seeds", "0").stderr
    assert "train: up to date" in said
    assert bench.made() == first
    bench("ball", "cup", "--seeds", "0")
    second = bench.made()
    assert len(second) == 2 * len(first) and first.items() <= second.items()


def test_a_failed_cell_is_noted_and_the_others_go_on(bench: Bench) -> None:
    bench.scene("bad", "diverging")
    bench.scene("broken", "native")
    result = bench("bad", "broken", "ball", "--seeds", "0,1", code=67)
    cells = bench.cells()
    assert cells["bad-glossy-s0"]["reason"] == "training diverged | at step 3"
    assert "internal error: ZeroDivisionError" in cells["broken-glossy-s1"]["reason"]
    assert ".jsonl" in cells["broken-glossy-s1"]["reason"]
    assert {cells[f"ball-glossy-s{seed}"]["status"] for seed in (0, 1)} == {"done"}
    assert "2 of 6 cells finished" in result.stderr and "bad-glossy-s0" in result.stderr
    table = (bench.out / "bench.md").read_text()
    assert "failed: training diverged \\| at step 3 |" in table
    (bad,) = [m for m in bench.record()["scenes"] if m["scene"] == "bad"]
    assert (bad["done"], bad["of"], bad["figures"]) == (0, 2, {})
    bench.scene("bad", "mended")
    bench("bad", "ball", "--seeds", "0,1")
    assert bench.cells()["bad-glossy-s0"]["status"] == "done"


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_a_signal_stops_the_bench_and_a_later_call_goes_on(
    bench: Bench, number: int, code: int
) -> None:
    process = bench.start("ball", "cup", "--out", "out", FAKE_STEP_S="0.2")
    deadline = time.monotonic() + 30
    while not list(bench.out.glob("cup-*/train/.scratch-*/done")):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.02)
    assert bench.cells()["ball-glossy-s0"]["status"] == "done"  # written after every cell
    time.sleep(0.5)
    process.send_signal(number)
    _, said = process.communicate(timeout=20)
    assert process.returncode == code and "Traceback" not in said
    assert "stopped in cup-glossy-s0.refdgs" in said and "run again to go on" in said
    stopped = bench.cells()["cup-glossy-s0"]
    assert stopped["status"] == "stopped"
    (spent,) = stopped["stopped_s"].values()
    assert 0.4 < spent < 10
    before = bench.made()
    bench("ball", "cup")
    assert before.items() <= bench.made().items()
    cell = bench.cells()["cup-glossy-s0"]
    assert cell["status"] == "done" and cell["train_s"] > spent  # the time of both parts
    manifest = next(bench.out.glob("cup-*/train/*/manifest.json"))
    assert ["resumed at", 0, ""] not in json.loads(manifest.read_text())["measures"]
    bench("ball", "cup")
    assert bench.cells()["cup-glossy-s0"]["train_s"] == cell["train_s"]  # and stays so


def test_a_kill_leaves_whole_tables_and_a_later_call_goes_on(bench: Bench) -> None:
    process = bench.start("ball", "cup", "--out", "out", FAKE_STEP_S="0.05")
    deadline = time.monotonic() + 30
    while not list(bench.out.glob("cup-*/train/.scratch-*/done")):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.02)
    process.kill()
    process.communicate(timeout=20)
    assert bench.cells()["cup-glossy-s0"]["status"] == "waiting"
    bench("ball", "cup")
    assert {cell["status"] for cell in bench.cells().values()} == {"done"}


def test_a_damaged_table_is_made_again(bench: Bench) -> None:
    bench("ball")
    (bench.out / "bench.json").write_text("{")
    bench("ball")
    assert bench.cells()["ball-glossy-s0"]["status"] == "done"


def test_other_settings_are_other_cells_of_the_same_workspaces(bench: Bench) -> None:
    bench("ball")
    bench("ball", "--set", "train.mood=mute", code=68)
    cell = bench.cells()["ball-glossy-s0"]
    assert cell["status"] == "failed" and "no voice" in cell["reason"]
    assert cell["figures"] == {} and cell["assignments"] == ["train.mood=mute", "start.seed=0"]


def test_json_is_the_record(bench: Bench) -> None:
    assert json.loads(bench("ball", "--json").stdout) == bench.record()


def test_a_second_bench_in_the_same_folder_is_refused(bench: Bench) -> None:
    process = bench.start("ball", "--out", "out", FAKE_STEP_S="0.5")
    deadline = time.monotonic() + 30
    while not (bench.out / "bench.json").exists():
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.02)
    assert "is working here" in bench("cup", code=72).stderr
    process.kill()
    process.communicate(timeout=20)


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["nowhere"], 65, "nowhere: no such file or folder"),
        (["ball", "--recipes", "glosy"], 64, "Did you mean glossy?"),
        (["ball", "--recipes", ","], 64, "expected at least one"),
        (["ball", "--seeds", "a"], 64, "expected whole numbers"),
        (["ball", "--seeds", "-1"], 64, "expected whole numbers"),
        (["ball", "--set", "start.seed=1"], 64, "are given by --seeds"),
        (["ball", "--set", "train.seed=1"], 64, "are given by --seeds"),
        (["ball", "--set", "train.speed=1"], 64, "no setting 'speed'"),
        (["ball", "other/ball"], 64, "two scenes are called ball"),
        (["ball", "--device", "tpu"], 64, "expected auto, cpu, cuda"),
        ([], 2, "Missing argument"),
    ],
)
def test_mistakes_are_said_before_anything_is_made(
    bench: Bench, arguments: list[str], code: int, words: str
) -> None:
    bench.scene("other/ball", "hello")
    assert words in bench(*arguments, code=code).stderr
    assert not bench.out.exists()
