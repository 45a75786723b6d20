"""Core-milliseconds of the rasteriser on a fixed scene: surfels on a noisy sphere, one thread.

    pytest -m benchmark tests/benchmarks/bench_rasterize.py -s

With REFDGS_PROTOTYPE=<folder of raster_cpu> the prototype is built and timed in the same run. The
prototype leaves out projection; ours is timed with it, with binning, and back to every parameter.
"""

import ctypes
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from refdgs_pipe.ops import Maps, Pinhole, Surfels, rasterize
from refdgs_pipe.ops.native import isa, keep_freed_memory

CASES = ((400, 20_000), (800, 50_000), (800, 200_000))
REPEATS = 7
CHANNELS = 11  # 8 features and the normal; and depth: twelve


def core_ms(work: Callable[[], object]) -> float:
    """Process CPU time of one call, milliseconds."""
    start = time.process_time()
    work()
    return 1e3 * (time.process_time() - start)


def sphere_scene(n: int, seed: int = 0) -> tuple[Surfels, torch.Tensor]:
    """Discs on a unit sphere with radial noise and tilt, log-normal sizes, all opacities."""
    r = np.random.default_rng(seed)
    d = r.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    means = d * (1 + 0.01 * r.normal(size=(n, 1)))
    normal = d + 0.15 * r.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    x, y, z = normal.T
    tilt = np.stack([1 + z, -y, x, 0 * z], -1)
    spin = r.uniform(0, 2 * np.pi, size=n)
    c, s = np.cos(spin / 2), np.sin(spin / 2)
    w, i, j, _ = tilt.T
    quats = np.stack([w * c, i * c + j * s, j * c - i * s, w * s], -1)
    scales = 0.6 * math.sqrt(4 * math.pi / n) * np.exp(0.4 * r.normal(size=(n, 2)))
    opacities = 1 / (1 + np.exp(-1.5 * r.normal(size=n)))
    features = r.uniform(size=(n, CHANNELS - 3))
    tensors = [torch.from_numpy(a.astype(np.float32)) for a in (means, quats, scales, opacities)]
    return Surfels(*tensors), torch.from_numpy(features.astype(np.float32))


def camera(size: int) -> Pinhole:
    pose = torch.eye(4)
    pose[2, 3] = 3.2
    focal = 0.5 * size / math.tan(math.radians(45) / 2)
    return Pinhole(pose, focal, focal, size / 2, size / 2, size, size, near=0.05)


def ours(size: int, n: int, threads: int = 1) -> tuple[float, float]:
    """Median core-ms of forward and backward through autograd, from surfels to planes and back.

    Gradients are put on the maps themselves: weighting and summing them is torch's work, not the
    rasteriser's.
    """
    surfels, features = sphere_scene(n)
    leaves = [t.requires_grad_() for t in (*vars(surfels).values(), features)]
    view = camera(size)
    g = torch.Generator().manual_seed(0)
    times: list[tuple[float, float]] = []
    for _ in range(REPEATS + 1):  # the first warms up
        drawn_maps: list[Maps] = []

        def forward(drawn_maps: list[Maps] = drawn_maps) -> None:
            maps = rasterize(surfels, features, view, extra="depth", normals=True, threads=threads)
            drawn_maps.append(maps)

        drawn = core_ms(forward)
        maps = drawn_maps[0]
        assert maps.normal is not None and maps.depth is not None
        images = [maps.features, maps.normal, maps.alpha, maps.depth]
        weights = [torch.randn(i.permute(2, 0, 1).shape, generator=g) for i in images[:2]]
        pulls = [w.permute(1, 2, 0) / size**2 for w in weights]
        pulls += [torch.randn(i.shape, generator=g) / size**2 for i in images[2:]]
        for leaf in leaves:
            leaf.grad = None
        replayed = core_ms(partial(torch.autograd.backward, images, pulls))
        times.append((drawn, replayed))
    forwards, backwards = zip(*times[1:], strict=True)
    return statistics.median(forwards), statistics.median(backwards)


def prototype(folder: Path, size: int, n: int) -> tuple[float, float]:
    library = folder_for_build() / "proto11.so"
    if not library.exists():
        command = ["g++", "-O3", "-std=c++17", "-march=native", "-shared", "-fPIC", "-DNF=11"]
        source = folder / "raster_avx512.cpp"
        subprocess.run([*command, str(source), "-o", str(library), "-pthread"], check=True)
    ctypes.CDLL(str(library))
    bench = [sys.executable, str(folder / "bench.py"), "--lib", str(library)]
    out = subprocess.run(
        [*bench, "--size", str(size), "--n", str(n)], check=True, capture_output=True, text=True
    ).stdout
    words = out.replace(":", " ").split()
    return float(words[words.index("fwd") + 1]), float(words[words.index("bwd") + 1])


def folder_for_build() -> Path:
    folder = Path(__file__).parent.parent.parent / "build" / "benchmarks"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


@pytest.mark.benchmark
def test_rasterizer_against_the_prototype() -> None:
    keep_freed_memory()
    torch.set_num_threads(1)
    where = os.environ.get("REFDGS_PROTOTYPE")
    print(f"\n{isa()}, one thread, {REPEATS} repeats, core-ms (forward, backward)")
    for size, n in CASES:
        forward, backward = ours(size, n)
        line = f"{size}x{size} {n:>7} surfels  ours {forward:6.1f} {backward:6.1f}"
        if where:
            f, b = prototype(Path(where), size, n)
            ratio = (forward + backward) / (f + b)
            line += f"  prototype {f:6.1f} {b:6.1f}  ratio of sums {ratio:.2f}"
        print(line)
        assert forward > 0 and backward > 0
