"""Steps recorded as CUDA graphs against the same steps without: equal, and how fast.

python tests/gpu/graph.py --out FILE [--device cuda|cpu] [--side PX] [--iterations N] [--surfels N]

A procedural ball is trained through densifications and as parts of the field join.
"""

import argparse
import json
import sys
import time
import traceback
from pathlib import Path
from typing import Any

import torch

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
import scene as scenery  # noqa: E402
import training  # noqa: E402
from training_runs import Settings  # noqa: E402

from refdgs_pipe.training.trainer import Trainer  # noqa: E402

CLOSE = 0.05  # of the loss; every recording has proved itself on a step before
WARM = 0.6  # of the run, after which steps are timed


def run(options: argparse.Namespace, train: list[scenery.View], graph: str) -> dict[str, Any]:
    """A short run to its end; `graph` is "on" or "off"."""
    few = {"iterations": options.iterations, "surfels": options.surfels, "masked": "ball"}
    early = {"reflect_from": 0.1, "local_from": 0.3, "coarse_until": 0.0, "densify_every": 40}
    params = Settings.of({}).but(**few, **early, renew_at=1.0)
    chosen = argparse.Namespace(**vars(options), graph=graph)
    trainer: Trainer = training.trained(chosen, train, params)
    begin, warm = 0.0, int(WARM * params.train.iterations)
    for k in range(params.train.iterations):
        if k == warm:
            training.synchronize(options.device)
            begin = time.perf_counter()
        trainer.step()
    training.synchronize(options.device)
    ms = 1e3 * (time.perf_counter() - begin) / (params.train.iterations - warm)
    trainer._read(all_of_them=True)
    found = {"ms a step": ms, "replayed": trainer.steps.replayed, "loss": trainer.loss}
    return {**found, "state": {k: v.cpu() for k, v in trainer.field.state().items()}}


def largest(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> float:
    """The greatest relative difference by norm of any tensor; infinite where sizes differ."""
    if any(a[k].shape != b[k].shape for k in a):
        return float("inf")
    pairs = [(a[k].double(), b[k].double()) for k in a]
    return max(float((x - y).norm() / (x.norm() + 1e-30)) for x, y in pairs)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--side", type=int, default=800)
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--surfels", type=int, default=20_000)
    options = parser.parse_args()
    options.scene = None
    train, _ = scenery.procedural(options.side)
    record: dict[str, Any] = {"ok": False}
    try:
        without = run(options, train, "off")
        record |= {"ms a step without": without["ms a step"]}
        recorded = run(options, train, "on")
        same = without["state"].keys() == recorded["state"].keys()
        apart = largest(without["state"], recorded["state"]) if same else float("inf")
        record |= {
            "ms a step recorded": recorded["ms a step"],
            "steps": options.iterations,
            "replayed": recorded["replayed"],
            "losses": [without["loss"], recorded["loss"]],
            "largest difference": apart,
            "same bits": apart == 0,
        }
        replays = options.device == "cpu" or recorded["replayed"] > options.iterations // 2
        loss, other = record["losses"]
        record |= {
            "ok": bool(replays and abs(other - loss) <= CLOSE * loss),
        }
    except Exception as error:
        traceback.print_exc()
        record["problem"] = f"{type(error).__name__}: {error}"[:2000]
    options.out.write_text(json.dumps(record, indent=1))
    print(json.dumps(record))
    return 0 if record["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
