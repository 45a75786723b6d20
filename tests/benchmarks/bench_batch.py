"""What a batch costs beside the work: for a capture, for a job, and how that grows.

    pytest -m benchmark -s tests/benchmarks/bench_batch.py
    REFDGS_BATCH_SIZES=10,100,1000,5000 pytest -m benchmark -s tests/benchmarks/bench_batch.py

The stages take some milliseconds (tests/fake_stages.py); all else is real: engine, command line,
locks, shared results in a folder, Snakemake. Core-seconds are of all processes together. Batches of
more than MOST_RUN captures are planned by Snakemake, but their jobs are done in this process: that
counts their requests, and leaves what the second run has to compare. The plot is written to
build/benchmarks/batch-growth.svg.
"""

import io
import math
import os
import resource
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import redirect_stderr
from pathlib import Path

import pytest
from batches import BatchShell, needs_snakemake
from bench_rasterize import folder_for_build
from bench_scaling import exponent
from fake_cli import Small
from fake_stages import STAGES, Letters

from refdgs_pipe.cli.batch import parts, step
from refdgs_pipe.cli.batch.table import Batch
from refdgs_pipe.pipeline import catalog
from refdgs_pipe.sharing.objects import Objects
from refdgs_pipe.sharing.places import open_place

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(14_400), needs_snakemake]
SIZES = tuple(map(int, os.environ.get("REFDGS_BATCH_SIZES", "10,30,100").split(",")))
MOST_RUN = 100
RUN = ("batch", "run", "B", "--cores", "2")
DRAWN = ("planning, core-s", "planning, MB", "requests", "second run, core-s")
COLORS = ("#2a7de1", "#e1662a", "#2aa15a", "#a04bd0")
Figures = dict[str, float]
Line = tuple[list[int], list[float], float]  # captures, values, exponent
# a process of its own, whose children are those of one command alone
_MEASURE = (
    "import resource, subprocess, sys\n"
    "code = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)\n"
    "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss, code)\n"
)


def timed(shell: BatchShell, *arguments: str) -> tuple[float, float]:
    """Wall seconds and core-seconds of a command with all its children."""
    words = [sys.executable, *shell.command, *arguments]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(
        words, cwd=shell.root, env=shell.environment, capture_output=True, text=True
    )
    wall = time.monotonic() - start
    assert done.returncode == 0, done.stderr[-3000:]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def peak_mb(shell: BatchShell) -> float:
    """Memory of Snakemake while it plans the whole batch at once, in MB."""
    words = [sys.executable, "-m", "snakemake", "--snakefile", str(shell.batch / "Snakefile")]
    words += ["--directory", str(shell.batch), "--dry-run", "--nolock", "--cores", "2"]
    done = subprocess.run(
        [sys.executable, "-c", _MEASURE, *words],
        env=shell.environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert done[1] == "0"
    return int(done[0]) / 1000


def fill(shell: BatchShell) -> Counter[str]:
    """Do every job here, without Snakemake. Requests to the store: kind -> how many."""
    stores = list[Objects]()

    def opened(place: str) -> Objects:
        stores.append(open_place(place))
        return stores[-1]

    batch = Batch.read(shell.batch)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(catalog, "build", lambda store: Small(Letters, STAGES, store))
        patch.setattr(step, "open_place", opened)
        for capture in batch.captures:
            for part in parts.ENDS:
                with redirect_stderr(io.StringIO()):
                    result = step.step(batch, capture.name, part, step.How(threads=1))
                assert result.status == "done", result.message
    made = Counter[str]()
    for store in stores:
        made.update(store.requests)
    return made


def measure(root: Path, count: int) -> Figures:
    """All figures of a batch of that many captures."""
    root.mkdir()
    shell = BatchShell(root)
    shell.init("--cache", "share", **{f"c{i:05}": f"hello {i}" for i in range(count)})
    found = {"planning, MB": peak_mb(shell)}
    found["planning, s"], found["planning, core-s"] = timed(shell, *RUN, "--dry-run")
    if count <= MOST_RUN:
        found["run, s"], found["run, core-s"] = timed(shell, *RUN)
        found["core-s a capture"] = found["run, core-s"] / count
        found["core-s a job"] = found["run, core-s"] / count / 3
        assert set(shell.states().values()) == {"done"}
        for folder in ("B/workspaces", "B/steps", "B/logs", "share/ac", "share/cas"):
            shutil.rmtree(root / folder)
    requests = fill(shell)
    found["requests"] = requests.total()
    found |= {f"requests: {kind.upper()}": number for kind, number in sorted(requests.items())}
    found["second run, s"], found["second run, core-s"] = timed(shell, *RUN)
    _, found["status, core-s"] = timed(shell, "batch", "status", "B")
    return found


def test_growth(tmp_path: Path) -> None:
    """A row for each figure: its values, the exponent over all sizes, and over the last two."""
    found = {count: measure(tmp_path / str(count), count) for count in SIZES}
    lines, rows = dict[str, Line](), [("captures", *map(str, SIZES), "all", "last")]
    for name in dict.fromkeys(name for figures in found.values() for name in figures):
        sizes = [count for count in SIZES if name in found[count]]
        values = [found[count][name] for count in sizes]
        slopes = [math.nan] * 2
        if len(sizes) > 1:
            slopes = [exponent(sizes[i:], values[i:]) for i in (0, -2)]
        lines[name] = (sizes, values, slopes[1])
        cells = [cell(found[count].get(name)) for count in SIZES]
        rows.append((name, *cells, *(f"{slope:.2f}" for slope in slopes)))
    print()
    for row in rows:
        print("| " + " | ".join(row) + " |")
    place = folder_for_build() / "batch-growth.svg"
    place.write_text(drawn({name: lines[name] for name in DRAWN}))


def cell(value: float | None) -> str:
    """A figure in a table; empty where there is none."""
    return "" if value is None else f"{value:.3g}" if value < 1000 else f"{value:,.0f}"


def drawn(lines: Mapping[str, Line]) -> str:
    """Curves as SVG, log-log, each as a multiple of its first value."""
    width, height, left, top = 560, 330, 60, 20
    right, bottom = width - 20, height - 40
    counts = max((line[0] for line in lines.values()), key=len)
    most = max(y / values[0] for _, values, _ in lines.values() for y in values) * 1.2
    span = math.log(counts[-1] / counts[0])

    def place(x: float, y: float) -> tuple[float, float]:
        across = math.log(x / counts[0]) / span
        up = math.log(max(y, 1 / 1.2) * 1.2) / math.log(most * 1.2)
        return left + across * (right - left), bottom - up * (bottom - top)

    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        'font-family="sans-serif" font-size="11" fill="#888">',
        f'<rect x="{left}" y="{top}" width="{right - left}" height="{bottom - top}" fill="none" '
        'stroke="#888"/>',
    ]
    for count in counts:
        x, _ = place(count, 1)
        out.append(f'<text x="{x:.0f}" y="{bottom + 16}" text-anchor="middle">{count:,}</text>')
    for times in (10.0**i for i in range(int(math.log10(most)) + 1)):
        _, y = place(counts[0], times)
        out.append(f'<text x="{left - 6}" y="{y + 4:.0f}" text-anchor="end">{times:,.0f}x</text>')
    middle = (left + right) / 2
    out.append(f'<text x="{middle}" y="{height - 6}" text-anchor="middle">captures</text>')
    for row, ((name, (x, y, slope)), color) in enumerate(zip(lines.items(), COLORS, strict=True)):
        spots = [place(a, b / y[0]) for a, b in zip(x, y, strict=True)]
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in spots)
        out.append(f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="2"/>')
        out.extend(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{color}"/>' for a, b in spots)
        words = f"{name}: exponent {slope:.2f} between the last two"
        out.append(f'<text x="{left + 10}" y="{top + 18 + 16 * row}" fill="{color}">{words}</text>')
    return "\n".join([*out, "</svg>", ""])
