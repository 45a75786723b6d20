"""How the rasteriser's cost grows with surfels, pixels and channels, and what memory it takes.

    pytest -m benchmark -s tests/benchmarks/bench_scaling.py

One thread, core-milliseconds, the scene of bench_rasterize.py. Exponents are slopes of a straight
line through the logarithms. The plot is written to build/benchmarks/scaling.svg.
"""

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from bench_rasterize import camera, core_ms, folder_for_build, ours, sphere_scene

from refdgs_pipe.ops import rasterize
from refdgs_pipe.ops.native import keep_freed_memory

pytestmark = pytest.mark.benchmark
SURFELS = (12_500, 25_000, 50_000, 100_000, 200_000)
SIDES = (300, 400, 600, 800, 1200)
Line = tuple[str, list[float], list[float], float]  # name, x, core-ms, exponent


def exponent(x: list[float], y: list[float]) -> float:
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def test_scaling() -> None:
    keep_freed_memory()
    torch.set_num_threads(1)
    by_surfels = [ours(800, n) for n in SURFELS]
    by_side = [ours(side, 50_000) for side in SIDES]
    pixels = [float(side * side) for side in SIDES]
    lines: list[Line] = []
    for k, name in enumerate(("forward", "backward")):
        for what, x, times in (
            ("surfels at 800x800", [float(n) for n in SURFELS], by_surfels),
            ("pixels with 50,000 surfels", pixels, by_side),
        ):
            y = [t[k] for t in times]
            lines.append((f"{name}, {what}", x, y, exponent(x, y)))
    print()
    for name, x, y, slope in lines:
        points = "  ".join(f"{a:.0f}: {b:.1f}" for a, b in zip(x, y, strict=True))
        print(f"{name:38s} exponent {slope:.2f}   {points}")
    narrow, wide = channels(4), channels(12)
    print(
        f"channels 4 to 12, 800x800, 50,000 surfels: {narrow:.1f} to {wide:.1f} core-ms, ", end=""
    )
    print(f"{wide / narrow:.2f}x")
    (folder_for_build() / "scaling.svg").write_text(plot(lines))
    assert all(math.isfinite(line[3]) for line in lines)


def channels(count: int) -> float:
    """Forward and backward of that many channels, nothing else asked for."""
    surfels, _ = sphere_scene(50_000)
    features = torch.rand(50_000, count, requires_grad=True)
    leaves = [t.requires_grad_() for t in vars(surfels).values()]
    pull = torch.randn(count, 800, 800).permute(1, 2, 0) / 800**2
    times = []
    for _ in range(8):
        for leaf in (*leaves, features):
            leaf.grad = None
        times.append(
            core_ms(
                lambda: torch.autograd.backward(
                    [rasterize(surfels, features, camera(800)).features], [pull]
                )
            )
        )
    return float(np.median(times[1:]))


def test_memory() -> None:
    """Peak of a process above what it had before the first call, at 800x800 with 200,000."""
    out = subprocess.run(
        [sys.executable, __file__],
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    print(f"\n800x800, 200,000 surfels, forward + backward: {float(out):.0f} MB above the start")
    assert float(out) > 0


def peak_of_one_step() -> float:
    surfels, features = sphere_scene(200_000)
    leaves = [t.requires_grad_() for t in (*vars(surfels).values(), features)]
    view = camera(800)
    before = peak_kilobytes()
    for _ in range(2):
        maps = rasterize(surfels, features, view, extra="depth", normals=True, threads=2)
        assert maps.normal is not None and maps.depth is not None
        torch.autograd.backward([maps.features.sum(), maps.normal.sum(), maps.depth.sum()])
        for leaf in leaves:
            leaf.grad = None
    return (peak_kilobytes() - before) / 1024


def peak_kilobytes() -> int:
    """Of this process; ru_maxrss would remember the one that started it."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1])


def plot(lines: list[Line], width: int = 380, height: int = 260) -> str:
    """Two panels of log-log curves as SVG."""
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{2 * width}" height="{height}" ']
    out.append('font-family="sans-serif" font-size="11" fill="#888">')
    for panel, key in enumerate(("surfels", "pixels")):
        shown = [line for line in lines if f", {key}" in line[0]]
        xs = np.log10([v for line in shown for v in line[1]])
        ys = np.log10([v for line in shown for v in line[2]])
        left, top, w, h = panel * width + 50, 30, width - 70, height - 70

        def place(x: float, y: float, box: tuple[float, ...], xs=xs, ys=ys) -> str:  # type: ignore[no-untyped-def]
            left, top, w, h = box
            px = left + (math.log10(x) - xs.min()) / (xs.max() - xs.min()) * w
            py = top + h - (math.log10(y) - ys.min()) / (ys.max() - ys.min()) * h
            return f"{px:.1f},{py:.1f}"

        box = (left, top, w, h)
        out.append(
            f'<rect x="{left}" y="{top}" width="{w}" height="{h}" fill="none" stroke="#888"/>'
        )
        for color, (name, x, y, slope) in zip(("#2a7de1", "#e1662a"), shown, strict=True):
            points = " ".join(place(a, b, box) for a, b in zip(x, y, strict=True))
            out.append(
                f'<polyline points="{points}" fill="none" stroke="{color}" stroke-width="2"/>'
            )
            for a, b in zip(x, y, strict=True):
                cx, cy = place(a, b, box).split(",")
                out.append(f'<circle cx="{cx}" cy="{cy}" r="3" fill="{color}"/>')
            label = f"{name.split(',')[0]} {slope:.2f}"
            row = top + 16 + 15 * shown.index((name, x, y, slope))
            out.append(f'<text x="{left + 8}" y="{row}" fill="{color}">{label}</text>')
        low, high = 10 ** ys.min(), 10 ** ys.max()
        out.append(f'<text x="{left - 6}" y="{top + h}" text-anchor="end">{low:.0f}</text>')
        out.append(f'<text x="{left - 6}" y="{top + 10}" text-anchor="end">{high:.0f} ms</text>')
        first, last = 10 ** xs.min(), 10 ** xs.max()
        out.append(f'<text x="{left}" y="{top + h + 16}">{first:,.0f}</text>')
        out.append(
            f'<text x="{left + w}" y="{top + h + 16}" text-anchor="end">{last:,.0f} {key}</text>'
        )
    return "\n".join([*out, "</svg>", ""])


if __name__ == "__main__":
    print(peak_of_one_step())
