"""What a batch costs beside the work: for a capture, for a job, and how that grows.

    pytest -m benchmark -s tests/benchmarks/bench_batch.py
    REFDGS_BATCH_SIZES=10,100,1000 pytest -m benchmark -s tests/benchmarks/bench_batch.py

The stages take some milliseconds (tests/fake_stages.py); all else is real: engine, command line,
locks, shared results in a folder, Snakemake. Core-seconds are of all processes together.
"""

import math
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from batches import BatchShell, needs_snakemake

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(7200), needs_snakemake]
SIZES = tuple(map(int, os.environ.get("REFDGS_BATCH_SIZES", "10,30,100").split(",")))
Figures = dict[str, float]
# a process of its own, whose children are those of one command alone
_MEASURE = (
    "import resource, subprocess, sys\n"
    "code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)\n"
    "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, code)\n"
)


def timed(shell: BatchShell, *arguments: str) -> tuple[float, float]:
    """Wall seconds and core-seconds of a command with all its children."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    shell(*arguments) if arguments[0] != "batch" else _patient(shell, *arguments)
    wall = time.monotonic() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cores = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, cores


def _patient(shell: BatchShell, *arguments: str) -> None:
    process = shell.start(*arguments)
    _, said = process.communicate(timeout=7200)
    assert process.returncode == 0, said[-3000:]


def peak_mb(shell: BatchShell, count: int) -> float:
    """Memory of Snakemake while it plans the whole batch, in MB."""
    words = [sys.executable, "-m", "snakemake", "--snakefile", str(shell.batch / "Snakefile")]
    words += ["--directory", str(shell.batch), "--dry-run", "--nolock", "--cores", "2"]
    done = subprocess.run(
        [sys.executable, "-c", _MEASURE, *words],
        env=shell.environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert done[1] == "0", count
    return int(done[0]) / 1000


def measure(root: Path, count: int) -> Figures:
    """All figures of a batch of that many captures."""
    root.mkdir()
    shell = BatchShell(root)
    shell.init("--cache", "share", **{f"c{i:05}": f"hello {i}" for i in range(count)})
    memory = peak_mb(shell, count)
    plan_s, plan_cores = timed(shell, "batch", "run", "B", "--cores", "2", "--dry-run")
    run_s, run_cores = timed(shell, "batch", "run", "B", "--cores", "2")
    assert set(shell.states().values()) == {"done"}
    again_s, again_cores = timed(shell, "batch", "run", "B", "--cores", "2")
    _, status_cores = timed(shell, "batch", "status", "B")
    return {
        "planning, core-s": plan_cores,
        "planning, s": plan_s,
        "planning, MB": memory,
        "run, core-s": run_cores,
        "run, s": run_s,
        "core-s a capture": run_cores / count,
        "core-s a job": run_cores / count / 3,
        "second run, core-s": again_cores,
        "second run, s": again_s,
        "status, core-s": status_cores,
    }


def test_growth(tmp_path: Path) -> None:
    found = {count: measure(tmp_path / str(count), count) for count in SIZES}
    rows = [("captures", *map(str, SIZES), "exponent")]
    for name in found[SIZES[0]]:
        values = [found[count][name] for count in SIZES]
        slope = np.polyfit(np.log(SIZES), np.log(values), 1)[0] if len(SIZES) > 1 else math.nan
        rows.append((name, *(f"{value:.3g}" for value in values), f"{slope:.2f}"))
    print()
    for row in rows:
        print("| " + " | ".join(row) + " |")
