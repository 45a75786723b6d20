"""The headline figure: milliseconds of a recorded step at 100,000 and 30,000 surfels, 800 x 800.

python tests/gpu/headline.py --out FILE [--device cuda|cpu] [--side PX] [--surfels N] [--local N]
                             [--steps N] [--profile]

The ball of the other checks covers half of the image. Surfels start on its visual hull and are
never split or removed, so their number is exactly what was asked for. FILE is written after every
part: steps replayed, the same steps without a recording, the share of every kernel in the replay.
`--profile` marks one unrecorded step for a profiler and ends.
"""

import argparse
import itertools
import json
import re
import statistics
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import torch

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
import scene as scenery  # noqa: E402
import training  # noqa: E402
from training_runs import Settings  # noqa: E402

from refdgs_pipe.training.trainer import Trainer  # noqa: E402

WARM = 80  # steps before anything is measured; a recording is made among them
PROFILED = 20  # steps whose kernels are told apart
OURS = re.compile(
    r"enter<refdgs::cuda::(\w+)<float((?:, (?:\(int\))?\d+)*)(?:, refdgs::cuda::(\w+))?"
)


def trainer_of(options: argparse.Namespace) -> tuple[Trainer, float]:
    """A trainer with exactly the surfels asked for, and the share of pixels that are covered."""
    train, _ = scenery.procedural(options.side)
    counts = {"surfels": options.surfels, "local_surfels": options.local}
    still = {"densify_until": 0.0, "reset_every": 0.0, "renew_at": 1.0, "coarse_until": 0.0}
    params = Settings.of({}).but(
        **counts, **still, masked="hull", outline_cells=0.0, iterations=20_000, patience=0.0
    )
    trainer = training.trained(options, train, params)
    covered = sum(float((pixels[..., 3] > 127).mean()) for _, pixels in train) / len(train)
    return trainer, covered


def times_of(trainer: Trainer, options: argparse.Namespace) -> dict[str, Any]:
    """Steps one by one between events, and all of them by the wall; nothing waits between them."""
    on_gpu = options.device == "cuda"
    events = []
    training.synchronize(options.device)
    begin = time.perf_counter()
    for _ in range(options.steps):
        if on_gpu:
            event = torch.cuda.Event(enable_timing=True)
            event.record()
            events.append(event)
        trainer.step()
    if on_gpu:
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        events.append(event)
    training.synchronize(options.device)
    wall = 1e3 * (time.perf_counter() - begin) / options.steps
    out: dict[str, Any] = {"ms a step, mean by the wall": wall}
    if on_gpu:
        each = sorted(a.elapsed_time(b) for a, b in itertools.pairwise(events))
        out |= {
            "ms a step, median": statistics.median(each),
            "5 %": each[len(each) // 20],
            "95 %": each[-1 - len(each) // 20],
        }
    return out


def short(name: str) -> str:
    """A kernel's name without what says nothing."""
    found = OURS.search(name)
    if found is not None:
        return " ".join(
            [found[1], *re.findall(r"\d+", found[2]), *([found[3]] if found[3] else [])]
        )
    if "cub::" in name:
        return "CUB " + (re.findall(r"Device\w+", name) or ["kernel"])[0]
    return re.sub(r"<.*|\(.*", "", name.removeprefix("void "))[-60:] + " " + name[-40:]


def kernels_of(trainer: Trainer) -> dict[str, Any]:
    """What the GPU does in a step, by torch's profiler: microseconds and calls of each kernel."""
    from torch.profiler import ProfilerActivity, profile

    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA]) as seen:
        for _ in range(PROFILED):
            trainer.step()
        torch.cuda.synchronize()
    total: dict[str, float] = defaultdict(float)
    calls: dict[str, int] = defaultdict(int)
    spans = []
    for event in seen.events():
        length = event.time_range.end - event.time_range.start
        if length <= 0 or event.name.startswith(("cuda", "cuLaunch", "Activity Buffer")):
            continue
        spans.append((event.time_range.start, event.time_range.end))
        total[short(event.name)] += length
        calls[short(event.name)] += 1
    rows = [
        {"kernel": name, "calls": calls[name] / PROFILED, "us a step": spent / PROFILED}
        for name, spent in sorted(total.items(), key=lambda item: -item[1])
    ]
    busy, end = 0.0, 0.0
    for a, b in sorted(spans):
        busy += max(0.0, b - max(a, end))
        end = max(end, b)
    return {
        "kernels": rows,
        "launches a step": sum(row["calls"] for row in rows),
        "ms busy a step": busy / PROFILED / 1e3,
    }


def profiled(trainer: Trainer) -> None:
    """One usual step that a profiler looks at."""
    training.usual(trainer)
    for _ in range(5):
        trainer.step()
    torch.cuda.synchronize()
    torch.cuda.profiler.start()
    trainer.step()
    torch.cuda.synchronize()
    torch.cuda.profiler.stop()


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--side", type=int, default=800)
    parser.add_argument("--surfels", type=int, default=100_000)
    parser.add_argument("--local", type=int, default=30_000)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--warm", type=int, default=WARM)
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    options.scene, options.graph = None, "auto"
    trainer, covered = trainer_of(options)
    record: dict[str, Any] = {"ok": False, "covered": covered, "size": [options.side] * 2}
    if options.device == "cuda":
        record["GPU"] = torch.cuda.get_device_name()
    for _ in range(options.warm):
        trainer.step()
    if options.profile:
        profiled(trainer)
        return 0
    local = trainer.field.local
    record["surfels"] = [len(trainer.field.geometry), 0 if local is None else len(local)]

    def told(**more: Any) -> None:
        record.update(more)
        options.out.write_text(json.dumps(record, indent=1))
        print(json.dumps(more), flush=True)

    replayed = trainer.steps.replayed
    told(recorded=times_of(trainer, options))
    replayed = trainer.steps.replayed - replayed
    told(**{"replayed": replayed, "of": options.steps, "warnings": training.warnings})
    if options.device == "cuda":
        told(replay=kernels_of(trainer))
    trainer._read(all_of_them=True)
    if trainer.plan is not None:
        told(lists={str(key): most for key, most in trainer.plan._most.items()})
    training.usual(trainer)
    told(**{"not recorded": times_of(trainer, options)})
    trainer._read(all_of_them=True)
    told(ok=options.device != "cuda" or replayed > options.steps // 2, loss=trainer.loss)
    return 0 if record["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
