"""Every operation on the GPU in float32 against the CPU in float64, and against itself.

python tests/gpu/parity.py --out FILE [--device cuda|emulated] [--small] [--once] [--only CASE]

FILE is written after every case. A case that fails on the GPU can take its context with it: then
it is run again where every launch is waited for, to name the kernel, and the rest in a new process.
"""

import argparse
import faulthandler
import itertools
import json
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
from cases import Case, camera, cases  # noqa: E402

from refdgs_pipe import ops  # noqa: E402
from refdgs_pipe.ops import Pinhole, Plan, Surfels, cuda_fused, rasterize  # noqa: E402
from refdgs_pipe.training.surfels import step_all  # noqa: E402

LIMIT = 1e-4  # relative error by norm
# Single rows (pixels, surfels) are beyond float32: a pixel at a cut-off falls on either side, a
# disc seen edge-on has a determinant of rounding. These are left out before the norm is taken, and
# where the CPU's float32 is still above the limit, it is the measure.
OUTLIERS = 0.003
AS_GOOD = 3.0
REPEATS = 3
HANGS = 60.0  # seconds after which the log says where a case hangs
BEYOND = 1e30  # the error of what did not come to an end
EXPLAINED = 2  # failures that are run again to name their kernel
Named = dict[str, Tensor]
Run = Callable[[torch.dtype, str], Named]  # type and device to outputs and gradients


def weighted(parts: Named, seed: int = 5) -> Tensor:
    """A random combination of outputs, the same for every type and device."""
    total: Tensor | None = None
    for k, value in enumerate(parts.values()):
        g = torch.Generator().manual_seed(seed + k)
        pull = (torch.rand(value.shape, generator=g) - 0.3).to(value)
        term = (value * pull).sum()
        total = term if total is None else total + term
    assert total is not None
    return total


def pulled(inputs: Named, run: Callable[[Named], Named]) -> Named:
    """Outputs, and the gradients of their combination by every input."""
    leaves = {k: v.detach().clone().requires_grad_() for k, v in inputs.items()}
    out = run(leaves)
    weighted(out).backward()  # type: ignore[no-untyped-call]
    grads = {f"d/d {k}": v.grad for k, v in leaves.items() if v.grad is not None}
    return {k: v.detach() for k, v in {**out, **grads}.items()}


def drawing(case: Case, *, planned: bool = False) -> Run:
    """The rasteriser on a case; planned: a second time, with room by what the first one needed."""
    made, features = case.make()

    def run(dtype: torch.dtype, device: str) -> Named:
        inputs = {f.name: getattr(made, f.name).to(device, dtype) for f in fields(made)}
        view = camera(*case.size)
        # the pose stays on the CPU, as in training
        inputs |= {"features": features.to(device, dtype), "pose": view.cam_from_world.to(dtype)}

        def draw(leaves: Named) -> Named:
            s = Surfels(*(leaves[f.name] for f in fields(Surfels)))
            posed = Pinhole(leaves["pose"], *list(vars(view).values())[1:])
            plan = Plan(device) if planned else None
            for _ in range(1 + planned):
                if plan is not None:
                    plan.begin()
                maps = rasterize(
                    s,
                    leaves["features"],
                    posed,
                    extra=case.extra,
                    normals=case.normals,
                    plan=plan,  # type: ignore[arg-type]
                )
            named = {f.name: getattr(maps, f.name) for f in fields(maps)}
            return {k: v for k, v in named.items() if isinstance(v, Tensor)}

        return pulled(inputs, draw)

    return run


def fused(*, small: bool) -> dict[str, Run]:
    """The other operations."""
    g = torch.Generator().manual_seed(11)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g)

    points, map_height = (150, 16) if small else (100_000, 256)
    widths = [10, 64, 64, 64, 3]
    net = {"x": 2 * random(points, 10) - 1}
    for l, (a, b) in enumerate(itertools.pairwise(widths)):
        net |= {f"w{l}": (random(b, a) - 0.5) * (6 / a) ** 0.5, f"b{l}": random(b) - 0.5}

    def mlp(p: Named) -> Named:
        layers = range(len(widths) - 1)
        return {"out": ops.mlp(p["x"], [p[f"w{l}"] for l in layers], [p[f"b{l}"] for l in layers])}

    encoding = {
        "map": random(map_height, 2 * map_height, 4) - 0.5,
        "directions": random(points, 3) - 0.5,
        "roughness": random(points),
    }

    def sph_mip(p: Named) -> Named:
        return {"features": ops.sph_mip(p["map"], p["directions"], p["roughness"])}

    def loss(height: int, width: int) -> Run:
        image, target, weight = (
            random(height, width, 3),
            random(height, width, 3),
            random(height, width),
        )

        def run(dtype: torch.dtype, device: str) -> Named:
            y, w = target.to(device, dtype), weight.to(device, dtype)
            inputs = {"image": image.to(device, dtype)}
            return pulled(inputs, lambda p: {"loss": ops.image_loss(p["image"], y, weight=w)})

        return run

    tensors = {f"p{k}": random(points, 3) - 0.5 for k in range(34)}

    def adam(dtype: torch.dtype, device: str) -> Named:
        leaves = {k: v.to(device, dtype).clone().requires_grad_() for k, v in tensors.items()}
        made = torch.optim.Adam(leaves.values(), lr=0.01, eps=1e-15, fused=True)
        for turn in range(3):
            for k, leaf in leaves.items():
                leaf.grad = (tensors[k].flip(0) * 10.0 ** (turn - 3)).to(device, dtype)
            step_all([], [made])
        return {k: v.detach() for k, v in leaves.items()}

    sizes = [(29, 37)] if small else [(1, 1), (5, 70), (217, 333), (800, 800)]
    out = {
        "network": _plain(net, mlp),
        "network by multiply-adds": _without_tensor_cores(_plain(net, mlp)),
        "Sph-Mip": _plain(encoding, sph_mip),
        "Adam": adam,
        "planned pixels": _planned(random),
        "shading": _shading((29, 37) if small else (217, 333), random),
    }
    return out | {f"image loss {w} x {h}": loss(h, w) for h, w in sizes}


def _plain(inputs: Named, run: Callable[[Named], Named]) -> Run:
    return lambda dtype, device: pulled({k: v.to(device, dtype) for k, v in inputs.items()}, run)


def _planned(random: Callable[..., Tensor]) -> Run:
    """Half of the pixels, shaded through lists with room to spare."""
    height, width = 117, 133
    inputs = {
        "features": random(height, width, 4),
        "alpha": random(height, width),
        "normal": random(height, width, 3) - 0.5,
        "map": random(64, 128, 4) - 0.5,
        "w0": (random(64, 6) - 0.5) / 2, "b0": random(64) - 0.5,
        "w1": (random(3, 64) - 0.5) / 2, "b1": random(3) - 0.5,
    }  # fmt: skip
    backdrop, view = random(3), camera(width, height)

    def shade(p: Named) -> Named:
        alpha, plan = p["alpha"], Plan(str(p["alpha"].device))
        plan.begin()
        pixels = ops.covered_pixels(alpha, 0.5, plan)
        limit = plan.last() if len(pixels) and bool((pixels < 0).any()) else None
        diffuse, roughness, reflected, cosine, _ = ops.shading_inputs(
            p["features"], alpha, p["normal"], None, pixels, view
        )
        far = ops.sph_mip(p["map"], reflected, roughness, limit=limit)
        x = torch.cat([far, roughness[:, None], cosine[:, None]], -1)
        weights, biases = [p["w0"], p["w1"]], [p["b0"], p["b1"]]
        radiance = ops.mlp(x, weights, biases, exp_cap=2.0, limit=limit)
        image = ops.composite(diffuse, radiance, pixels, alpha, alpha, backdrop.to(alpha))
        return {"image": image}

    return _plain(inputs, shade)


def _without_tensor_cores(run: Run) -> Run:
    def other(dtype: torch.dtype, device: str) -> Named:
        cuda_fused.TENSOR_CORES = False
        try:
            return run(dtype, device)
        finally:
            cuda_fused.TENSOR_CORES = True

    return other


def _shading(size: tuple[int, int], random: Callable[..., Tensor]) -> Run:
    height, width = size
    alpha = 0.1 + 0.8 * random(height, width)
    inputs = {
        "features": random(height, width, 6),
        "alpha": alpha,
        "normal": random(height, width, 3) - 0.5,
        "near": random(height, width, 4) - 0.5,
        "depth": (2 + random(height, width)) * alpha,
        "radiance": random(height * width // 2, 3),
        "behind": 0.2 * random(height, width, 3),
    }
    pixels, backdrop = torch.arange(0, height * width // 2 * 2, 2), random(3)
    view = camera(width, height)

    def shade(p: Named) -> Named:
        there = pixels.to(p["alpha"].device)
        diffuse, roughness, reflected, cosine, near = ops.shading_inputs(
            p["features"], p["alpha"], p["normal"], p["near"], there, view
        )
        image = ops.composite(
            diffuse, p["radiance"], there, 0.9 * p["alpha"], p["alpha"],
            backdrop.to(p["alpha"]), p["behind"],
        )  # fmt: skip
        agreement = ops.normal_agreement(p["normal"], p["depth"], p["alpha"], view, edge=1e3)
        assert near is not None
        named = {"diffuse": diffuse, "roughness": roughness, "reflected": reflected}
        named |= {"cosine": cosine, "near": near}
        return named | {"image": image, "agreement": agreement * height * width}

    return _plain(inputs, shade)


def error_of(found: Tensor, wanted: Tensor) -> tuple[float, float]:
    """|found - wanted| / |wanted| by norm: without the outliers, and of all.

    0 where both are empty or zero.
    """
    width = wanted.shape[-1] if wanted.ndim > 1 and wanted.shape[-1] <= 20 else 1
    rows = (found.double().cpu() - wanted).reshape(-1, width).norm(dim=1).sort().values
    norm = float(wanted.norm()) or 1.0
    kept = rows[: len(rows) - int(OUTLIERS * len(rows))]
    return float(kept.norm()) / norm, float(rows.norm()) / norm


def check(
    name: str, run: Run, device: str, on: Callable[[], Any], repeats: int
) -> list[dict[str, Any]]:
    """One row for each output and gradient."""
    wanted, usual = run(torch.float64, "cpu"), run(torch.float32, "cpu")
    found = []
    for _ in range(repeats):
        with on():
            found.append(run(torch.float32, device))
    rows = []
    for output, value in wanted.items():
        error, whole = error_of(found[0][output], value)
        theirs, their_whole = error_of(usual[output], value)
        same = all(torch.equal(found[0][output], other[output]) for other in found[1:])
        if output == "d/d pose":  # a sum over all surfels, outliers and all: as exact as its terms
            terms = wanted["d/d means"]
            theirs = max(theirs, *(error_of(r["d/d means"], terms)[1] for r in (usual, found[0])))
        row = {"case": name, "output": output, "error": error, "with outliers": whole}
        row |= {"cpu float32": theirs, "cpu float32 with outliers": their_whole}
        ok = error <= max(LIMIT, AS_GOOD * theirs)
        rows.append({**row, "within": ok, "same every time": same, "ok": ok and same})
    return rows


def failed(name: str, why: str) -> dict[str, Any]:
    """The row of a case that raised."""
    row = {"case": name, "output": "-", "error": BEYOND, "cpu float32": 0.0}
    return {**row, "same every time": False, "ok": False, "why": why}


def explained(name: str, options: argparse.Namespace) -> str:
    """What a case says in a process of its own that waits for every launch."""
    command = [sys.executable, __file__, "--only", name, "--once", "--out", os.devnull]
    blocking = {**os.environ, "CUDA_LAUNCH_BLOCKING": "1"}
    try:
        done = subprocess.run(
            [*command, *(["--small"] if options.small else [])],
            env=blocking, capture_output=True, text=True, timeout=40, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "alone, it does not end within 40 s"
    return "alone: " + (done.stdout + done.stderr)[-700:]


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--once", action="store_true", help="no repeats")
    parser.add_argument("--only", help="this case alone")
    parser.add_argument("--start", type=int, default=0, help="go on with this case")
    options = parser.parse_args()
    device, on = options.device, nullcontext
    if device == "emulated":
        from emulation import emulated

        device, on = "cpu", emulated
    jobs = {case.name: drawing(case) for case in cases(small=options.small)}
    jobs["random, planned"] = drawing(cases(small=options.small)[0], planned=True)
    jobs |= fused(small=options.small)
    begin, rows, spent = time.monotonic(), [], 0.0
    if options.start:
        record = json.loads(options.out.read_text())
        rows, spent = record["rows"], record["seconds"]
    for index, (name, run) in enumerate(jobs.items()):
        if index < options.start or (options.only and name != options.only):
            continue
        print(f"{time.monotonic() - begin:6.1f} s  {name}", flush=True)
        broken = None
        faulthandler.dump_traceback_later(HANGS)
        try:
            rows += check(name, run, device, on, 1 if options.once else REPEATS)
        except Exception as error:
            traceback.print_exc()
            broken = f"{type(error).__name__}: {error}"[:700]
        faulthandler.cancel_dump_traceback_later()
        if broken and device == "cuda" and not options.only:
            if sum("why" in row for row in rows) < EXPLAINED:
                broken += "\n" + explained(name, options)
            print(broken, flush=True)
        if broken:
            rows.append(failed(name, broken))
        seconds = spent + time.monotonic() - begin
        record = {"ok": all(row["ok"] for row in rows), "limit": LIMIT, "seconds": seconds}
        record |= {"cases": len(jobs), "rows": rows}
        options.out.write_text(json.dumps(record, indent=1))
        if broken and device == "cuda" and not options.only:
            again = [__file__, *sys.argv[1:], "--start", str(index + 1)]
            os.execv(sys.executable, [sys.executable, *again])
    return verdict(rows)


def verdict(rows: list[dict[str, Any]]) -> int:
    """Says what is not as it should be; 1 if there is such."""
    for row in rows:
        if not row["ok"]:
            print("FAILED", row)
    ok = bool(rows) and all(row["ok"] for row in rows)
    worst = max((row["error"] for row in rows), default=BEYOND)
    all_of = "all" if ok else "NOT all"
    print(f"{len(rows)} outputs, worst error {worst:.2e}, {all_of} as they should be")
    return 0 if ok else 1


if __name__ == "__main__":
    sys.exit(main())
