"""How long every operation takes on the GPU, against the floor of its bytes and arithmetic.

python tests/gpu/timing.py --out FILE [--device cuda|emulated] [--small]
"""

import argparse
import itertools
import json
import math
import re
import statistics
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
from cases import camera, surfels  # noqa: E402

from refdgs_pipe import ops  # noqa: E402
from refdgs_pipe.ops import Surfels, adam_step, rasterize  # noqa: E402
from refdgs_pipe.ops.gpu import mlp as network  # noqa: E402
from refdgs_pipe.ops.gpu import rasterize as tiles  # noqa: E402

WARM, REPEATS = 5, 20
PAIRS = 16.0  # pixels of a patch that an entry is blended into, about
LARGER = 2.0  # than the parity's: some 20 surfels on a pixel of the object
KERNEL = re.compile(r"enter<refdgs::cuda::(\w+)<float(?:, (?:\(int\))?(\d+), (?:\(int\))?(\d+))?")


class Clock:
    """Milliseconds of a call: by the GPU's events, or by the wall on a CPU."""

    def __init__(self, device: str) -> None:
        self.device = device

    def ms(self, work: Callable[[], object]) -> float:
        """The median of some calls after a few to warm up."""
        times = []
        for turn in range(WARM + REPEATS if self.device == "cuda" else 1):
            if self.device != "cuda":
                start = time.perf_counter()
                work()
                times.append(1e3 * (time.perf_counter() - start))
                continue
            begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            torch.cuda.synchronize()
            begin.record()
            work()
            end.record()
            torch.cuda.synchronize()
            if turn >= WARM:
                times.append(begin.elapsed_time(end))
        return statistics.median(times)


def rates(clock: Clock) -> tuple[float, float]:
    """Bytes and fp32 operations a second that this device reaches on a copy and a product."""
    numbers, side = (2**27, 8192) if clock.device == "cuda" else (2**20, 256)
    a = torch.empty(numbers, device=clock.device)
    b = torch.empty_like(a)
    copy = clock.ms(lambda: b.copy_(a))
    x = torch.randn(side, side, device=clock.device)
    torch.backends.cuda.matmul.allow_tf32 = False
    product = clock.ms(lambda: x @ x)
    return 8e3 * numbers / copy, 2e3 * side**3 / product


def detached(made: Surfels, device: str) -> Surfels:
    """The surfels on a device, as leaves."""
    return Surfels(*(t.to(device).requires_grad_() for t in vars(made).values()))


def drawing(clock: Clock, n: int, side: int, channels: int, extra: str) -> list[dict[str, Any]]:
    """Forward and backward of one set of surfels."""
    made, features = surfels(n, channels - (3 if extra != "none" else 0), seed=4)
    made = replace(made, scales=LARGER * made.scales)
    s, view = detached(made, clock.device), camera(side, side)
    f = features.to(clock.device).requires_grad_()
    counted: list[int] = []
    read = tiles._entries
    tiles._entries = lambda *a: counted.append(read(*a)) or counted[-1]  # type: ignore
    try:
        maps = rasterize(s, f, view, extra=extra, normals=extra != "none")  # type: ignore[arg-type]
    finally:
        tiles._entries = read
    entries, pixels = (counted or [0])[0], side * side
    # bytes and operations as the kernels' head comments have them
    planes, pairs = channels + (3 if extra == "depth" else 1), PAIRS * entries
    name = f"rasterise {n} surfels, {channels} channels, {side}x{side}, {entries} entries"
    forward = (
        n * (140 + 8 * channels + 64) + entries * (64 + 4 * (12 + channels)) + pixels * 4 * planes
    )
    work = pairs * (60 + 2 * channels)
    backward = pixels * 8 * planes + entries * 8 * (12 + channels) + n * 8 * (32 + channels)
    total = sum(m.sum() for m in (maps.features, maps.alpha))
    draw = lambda: rasterize(s, f, view, extra=extra, normals=extra != "none")  # type: ignore[arg-type]  # noqa: E731
    leaves = [*vars(s).values(), f]
    back = lambda: torch.autograd.grad(total, leaves, retain_graph=True)  # noqa: E731
    return [
        {"what": name, "ms": clock.ms(draw), "bytes": forward, "flop": work, "run": draw},
        {
            "what": name + ", backward",
            "ms": clock.ms(back),
            "bytes": backward,
            "flop": pairs * (140 + 5 * channels),
            "run": back,
        },
    ]


def fused(clock: Clock, side: int) -> list[dict[str, Any]]:
    """The other operations, half of the image covered."""
    device, pixels = clock.device, side * side
    points = pixels // 2
    g = torch.Generator().manual_seed(1)

    def leaf(*shape: int) -> Tensor:
        return (torch.rand(*shape, generator=g) + 0.1).to(device).requires_grad_()

    x, base = leaf(points, 10), leaf(256, 512, 4)
    directions, roughness = leaf(points, 3), leaf(points)
    widths = [10, 64, 64, 64, 3]
    weights = [leaf(b, a) for a, b in itertools.pairwise(widths)]
    biases = [leaf(b) for b in widths[1:]]
    image, target = leaf(side, side, 3), torch.rand(side, side, 3, generator=g).to(device)
    features, alpha = leaf(side, side, 8), leaf(side, side)
    normal, near = leaf(side, side, 3), leaf(side, side, 4)
    depth, there, view = leaf(side, side), torch.arange(points, device=device), camera(side, side)
    radiance, backdrop = leaf(points, 3), torch.rand(3, generator=g).to(device)
    texels = 256 * 512 * 4 / 3
    jobs: dict[str, tuple[Callable[[], Tensor], float, float, float, float]] = {
        # forward bytes, flop; backward bytes, flop
        "network": (
            lambda: ops.mlp(x, weights, biases), 52.0 * points, 18_304.0 * points,
            120.0 * points, 73_000.0 * points,
        ),
        "network, bfloat16": (
            lambda: ops.mlp(x, weights, biases, half=True), 52.0 * points, 18_304.0 * points,
            120.0 * points, 73_000.0 * points,
        ),
        "Sph-Mip": (
            lambda: ops.sph_mip(base, directions, roughness), 44.0 * points + 24 * texels,
            200.0 * points, 300.0 * points + 80 * texels, 400.0 * points,
        ),
        "image loss (gradient in forward)": (
            lambda: ops.image_loss(image, target), 132.0 * pixels, 810.0 * pixels,
            24.0 * pixels, 0.0,
        ),
        "shading inputs": (
            lambda: ops.shading_inputs(features, alpha, normal, near, there, view)[0],
            108.0 * points, 100.0 * points, 150.0 * points + 64 * pixels, 200.0 * points,
        ),
        "composite": (
            lambda: ops.composite(radiance, radiance, there, alpha, alpha, backdrop),
            16.0 * pixels + 60 * points, 60.0 * points, 24.0 * pixels + 60 * points, 80.0 * points,
        ),
        "normal agreement (gradient in forward)": (
            lambda: ops.normal_agreement(normal, depth, alpha, view), 96.0 * pixels,
            300.0 * pixels, 40.0 * pixels, 0.0,
        ),
    }  # fmt: skip
    tensors = [leaf(130_000 if side > 100 else 50, 14), leaf(256, 512, 4)]
    made = torch.optim.Adam(tensors, eps=1e-15, fused=True)
    numbers = sum(t.numel() for t in tensors)

    def adam() -> None:
        for t in tensors:
            t.grad = t.detach()
        adam_step([made], None)

    row = {"what": f"Adam, {numbers} numbers", "ms": clock.ms(adam), "bytes": 28.0 * numbers}
    out: list[dict[str, Any]] = [{**row, "flop": 12.0 * numbers, "run": adam}]
    leaves = [x, base, directions, roughness, *weights, *biases, image, features, alpha, normal]
    leaves += [near, depth, radiance]
    jobs["network by multiply-adds"] = jobs["network"]
    for name, (run, bytes_in, flop, bytes_back, flop_back) in jobs.items():
        network.TENSOR_CORES = "multiply-adds" not in name
        total = run().sum()
        back = lambda t=total: torch.autograd.grad(t, leaves, retain_graph=True, allow_unused=True)  # noqa: E731
        out.append({"what": name, "ms": clock.ms(run), "bytes": bytes_in, "flop": flop, "run": run})
        row = {"what": name + ", backward", "ms": clock.ms(back), "bytes": bytes_back}
        out.append({**row, "flop": flop_back, "run": back})
    network.TENSOR_CORES = True
    return out


def kernels(runs: list[Callable[[], object]]) -> list[dict[str, Any]]:
    """Microseconds a call of each kernel by torch's profiler; empty where it cannot say."""
    from torch.profiler import ProfilerActivity, profile

    try:
        with profile(activities=[ProfilerActivity.CUDA]) as seen:
            for run in runs:
                run()
            torch.cuda.synchronize()
        rows = []
        for event in seen.key_averages():
            found = KERNEL.search(event.key)
            name = None if found is None else " ".join(part for part in found.groups() if part)
            if name is None and "cub::" in event.key:
                name = "CUB " + (re.findall(r"Device\w+", event.key) or ["kernel"])[0]
            total = getattr(event, "device_time_total", 0) or getattr(event, "cuda_time_total", 0)
            if name and event.count:
                rows.append({"kernel": name, "calls": event.count, "us": total / event.count})
        return sorted(rows, key=lambda row: -row["us"] * row["calls"])
    except (RuntimeError, AttributeError) as error:
        print("no profile:", error)
        return []


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--small", action="store_true")
    options = parser.parse_args()
    on = nullcontext
    device = options.device
    if device == "emulated":
        from emulation import emulated

        device, on = "cpu", emulated
    clock = Clock(device)
    with on():
        rate, flops = rates(clock)
        side = 48 if options.small else 800
        counts = (200, 100) if options.small else (100_000, 30_000)
        rows, problems = [], []
        parts = {
            "geometry": lambda: drawing(clock, counts[0], side, 12, "depth"),
            "local": lambda: drawing(clock, counts[1], side, 4, "none"),
            "fused": lambda: fused(clock, side),
        }
        for name, part in parts.items():
            print(name, flush=True)
            try:
                rows += part()
            except Exception as error:  # what else can be timed is timed
                traceback.print_exc()
                problems.append(f"{name}: {error}"[:700])
        runs = [row.pop("run") for row in rows]
        table = kernels(runs) if device == "cuda" and not problems else []
    for row in rows:
        row["floor ms"] = 1e3 * max(row["bytes"] / rate, row["flop"] / flops)
        row["times the floor"] = row["ms"] / row["floor ms"] if row["floor ms"] else math.inf
    record = {"GB/s": rate / 1e9, "TFLOP/s": flops / 1e12, "rows": rows, "kernels": table}
    record |= {"problems": problems}
    options.out.write_text(json.dumps(record, indent=1))
    for row in rows:
        print(f"{row['what']:75} {row['ms']:8.3f} ms, floor {row['floor ms']:.3f}")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
