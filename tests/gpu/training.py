"""A whole training on one device, timed and scored on held-out views.

python tests/gpu/training.py --out FILE [--scene DIR] [--device cuda|cpu] [--seconds S] [--side PX]
                             [--iterations N] [--surfels N] [--graph auto|on|off]

DIR is a NeRF-synthetic folder (transforms_train.json, transforms_test.json, RGBA images); without
one a procedural ball is drawn. None of the libraries for other stages is loaded.
"""

import argparse
import json
import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parent.parent)]
import scene as scenery  # noqa: E402
from training_runs import Settings, trainer_of  # noqa: E402

from refdgs_pipe.metrics import psnr  # noqa: E402
from refdgs_pipe.ops.gpu import mlp as network  # noqa: E402
from refdgs_pipe.training.recorded import RecordedSteps  # noqa: E402
from refdgs_pipe.training.render import render_image  # noqa: E402
from refdgs_pipe.training.step import NEAR  # noqa: E402
from refdgs_pipe.training.trainer import Trainer  # noqa: E402

TEST_VIEWS = 20
REPEATED_STEPS = 60  # of two short runs that must agree bit for bit
warnings: list[str] = []


def synchronize(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()


def trained(options: argparse.Namespace, train: list[scenery.View], params: Settings) -> Trainer:
    """A trainer with nothing done yet."""
    radius = scenery.SYNTHETIC_RADIUS if options.scene else 1.1
    views, model = scenery.model_of(train, radius)
    near = NEAR * min(float(np.linalg.norm(c.center)) for c in model.cameras)
    scratch = Path(tempfile.mkdtemp())
    photos = scenery.photos_of(train, near)
    graph = {"auto": None, "on": True, "off": False}[options.graph]
    given = {"device": options.device, "cuda_graph": graph, "warn": warnings.append}
    return trainer_of(views, model, params, scratch, photos=photos, **given)


def usual(trainer: Trainer) -> None:
    """No more recorded steps."""
    trainer.steps = RecordedSteps(trainer.field, None)


def step_times(trainer: Trainer, device: str, steps: int) -> float:
    """Milliseconds of a step at the end of training, by the wall."""
    synchronize(device)
    start = time.perf_counter()
    for _ in range(steps):
        trainer.step()
    synchronize(device)
    return 1e3 * (time.perf_counter() - start) / steps


def repeats(options: argparse.Namespace, train: list[scenery.View], params: Settings) -> bool:
    """Whether two short runs end in the same bits."""
    early = {"masked": "ball", "reflect_from": 0.0, "local_from": 0.2, "densify_every": 20}
    few = {"iterations": REPEATED_STEPS, "surfels": min(params.start.surfels, 5000)}
    short = params.but(**early, **few)
    ends = []
    for _ in range(2):
        trainer = trained(options, train[:12], short)
        for _ in range(REPEATED_STEPS):
            trainer.step()
        ends.append(trainer.field.state())
    first, second = ends
    return all(torch.equal(value, second[name]) for name, value in first.items())


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--side", type=int, default=800)
    parser.add_argument("--iterations", type=int, default=8000)
    parser.add_argument("--surfels", type=int, default=20_000)
    parser.add_argument("--volume-steps", type=int, default=None, help="of the first shape")
    parser.add_argument("--graph", default="auto", choices=["auto", "on", "off"])
    options = parser.parse_args()
    params = Settings.of({})
    params = params.but(iterations=options.iterations, surfels=options.surfels, renew_at=1.0)
    if options.volume_steps is not None:
        params = params.but(volume_steps=options.volume_steps)
    if options.device == "cpu":  # where OpenCV shrinks photos
        params = params.but(coarse_until=0.0)
    begin = time.monotonic()
    if options.scene:
        train, test = scenery.read_folder(options.scene, options.side, TEST_VIEWS)
    else:
        train, test = scenery.procedural(options.side)
    read_s = time.monotonic() - begin
    same = repeats(options, train, params)
    begin = time.monotonic()
    trainer = trained(options, train, params)
    start_s, begin = time.monotonic() - begin, time.monotonic()
    seconds = {}
    while (
        trainer.iteration < params.train.iterations and time.monotonic() - begin < options.seconds
    ):
        trainer.step()
        if trainer.iteration % 1000 == 0:
            synchronize(options.device)
            seconds[trainer.iteration] = round(time.monotonic() - begin, 2)
            print(f"{trainer.iteration} steps, {seconds[trainer.iteration]} s", flush=True)
    synchronize(options.device)
    train_s, steps = time.monotonic() - begin, trainer.iteration
    replayed = trainer.steps.replayed
    trainer._read(all_of_them=True)
    field = trainer.field.freeze()
    figures, times = [], []
    for camera, pixels in test:
        start = time.perf_counter()
        image = render_image(field, camera, device=options.device)
        times.append(time.perf_counter() - start)
        alpha = pixels[..., 3:] / 255.0
        figures.append(psnr(image, pixels[..., :3] / 255.0 * alpha + (1 - alpha)))
    steps_at_end = min(50, options.iterations)
    recorded = step_times(trainer, options.device, steps_at_end)
    usual(trainer)
    planned = step_times(trainer, options.device, steps_at_end)
    network.TENSOR_CORES = False
    by_fma = step_times(trainer, options.device, steps_at_end)
    network.TENSOR_CORES = True
    trainer._read(all_of_them=True)
    trainer.plan = None
    waiting = step_times(trainer, options.device, steps_at_end)
    record: dict[str, Any] = {
        "ok": bool(same and math.isfinite(trainer.loss) and np.mean(figures) > 15),
        "same bits in two runs": same,
        "scene": "procedural ball" if options.scene is None else options.scene.name,
        "views": [len(train), len(test)],
        "size": [train[0][0].width, train[0][0].height],
        "steps": steps,
        "of steps": params.train.iterations,
        "seconds": train_s,
        "seconds at step": seconds,
        "ms a step": 1e3 * train_s / max(1, steps),
        "steps replayed": replayed,
        "warnings": warnings,
        "ms a step at the end": recorded,
        "ms a step at the end, not recorded": planned,
        "ms a step at the end, without tensor cores": by_fma,
        "ms a step at the end, waiting for every list": waiting,
        "test PSNR": float(np.mean(figures)),
        "train PSNR": trainer.psnr,
        "loss": trainer.loss,
        "ms a rendered view, median": 1e3 * float(np.median(times)),
        "surfels": {"geometry": len(field.geometry), "local": len(field.local)},
        "seconds to read": read_s,
        "seconds to start": start_s,
    }
    if options.device == "cuda":
        record["GPU memory, GB"] = torch.cuda.max_memory_allocated() / 1e9
    options.out.write_text(json.dumps(record, indent=1))
    print(json.dumps(record))
    return 0 if record["ok"] or options.iterations < 1000 else 1


if __name__ == "__main__":
    sys.exit(main())
