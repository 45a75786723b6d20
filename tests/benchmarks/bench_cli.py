"""How long the command line takes to answer; the aim is half a second.

pytest -m benchmark -s tests/benchmarks/bench_cli.py
"""

import json
import statistics
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.benchmark
ROUNDS = 7


def seconds(*arguments: str) -> float:
    taken = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        command = [sys.executable, "-m", "refdgs_pipe.cli.app", *arguments]
        subprocess.run(command, capture_output=True, check=True)
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def test_help_and_status_answer_at_once(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.jpg").write_bytes(b"\xff\xd8")
    memory = {"photos": [["photos", str(tmp_path / "photos")]], "recipe": "glossy", "set": []}
    (tmp_path / "workspace.json").write_text(json.dumps(memory))
    for arguments in (["--help"], ["status", str(tmp_path)], ["recipe", "show", "glossy"]):
        print(f"\n{arguments[0]:8} {seconds(*arguments):.2f} s", end="")
