"""What each part of the training is worth: normals and pictures after a short budget.

    pytest -m benchmark -s tests/benchmarks/bench_ladder.py

Every cell (a row on a scene) is written to the folder REFDGS_LADDER (default: a new one) as JSON
when it is done, and a call goes on where an earlier one stopped. REFDGS_LADDER_ROWS names the rows
to run, with commas between; REFDGS_LADDER_SET is a JSON object of settings for all of them. Some
one to two minutes of one core for a cell.
"""

import json
import os
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from captures import SHARED, Stages, needs_shared
from training_runs import Settings
from training_runs import trained as trained_field

from refdgs_pipe import recipe
from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.truth import view_truth_files
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.evaluation.scoring import compare_maps
from refdgs_pipe.evaluation.truth import read_view_truth
from refdgs_pipe.metrics import psnr
from refdgs_pipe.surface.own import own_surface
from refdgs_pipe.surface.settings import ShapeParams
from refdgs_pipe.training import initial
from refdgs_pipe.training.render import render_image, render_surface_map

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3600)]

SCENES = ("spheres", "kettle", "mug")
BUDGET = {"iterations": 1500, "coarse_until": 0.5}
DIFFUSE_FIRST = {
    "reflect_from": 0.15,
    "local_from": 0.25,
    "rate_means": 1e-3,
    "specular_weight": 0.0,
    "turn_share": 0.0,
}
EVERY = 2  # every second held-out view is compared

# name -> recipe, and what is set besides
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "glossy": ("glossy", {}),
    "matte": ("matte", {}),
    "local=none": ("glossy", {"local": "none"}),
    "local=shared": ("glossy", {"local": "shared"}),
    "mixing=sum": ("glossy", {"mixing": "sum"}),
    "physical=false": ("glossy", {"physical": False}),
    "smooth_weight=0.05": ("glossy", {"smooth_weight": 0.05}),
    "smooth_weight=0": ("glossy", {"smooth_weight": 0.0}),
    "diffuse first": ("glossy", DIFFUSE_FIRST),
    "specular_weight=0": ("glossy", {"specular_weight": 0.0}),
    "specular_from=0.4": ("glossy", {"specular_from": 0.4}),
    "turn_share=0": ("glossy", {"turn_share": 0.0}),
    "renew_at=1": ("glossy", {"renew_at": 1.0}),
    "outline_cells=0": ("glossy", {"outline_cells": 0.0}),
    "volume_steps=0": ("glossy", {"volume_steps": 0}),
    "masked=hull": ("glossy", {"masked": "hull"}),
    "paper-shiny": ("paper-shiny", {"coarse_until": 0.0}),
    "distortion_weight=0": ("glossy", {"distortion_weight": 0.0}),
    "full size throughout": ("glossy", {"coarse_until": 0.0}),
    "seed=1": ("glossy", {"seed": 1}),
    "matte seed=1": ("matte", {"seed": 1}),
    "local=shared seed=1": ("glossy", {"local": "shared", "seed": 1}),
    "local=none seed=1": ("glossy", {"local": "none", "seed": 1}),
}


def cells() -> Iterator[tuple[str, str]]:
    wanted = os.environ.get("REFDGS_LADDER_ROWS", ",".join(ROWS)).split(",")
    for row in ROWS:
        if row in wanted:
            yield from ((row, scene) for scene in SCENES)


@pytest.fixture(scope="module")
def results() -> Path:
    folder = os.environ.get("REFDGS_LADDER") or tempfile.mkdtemp()
    Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder)


@pytest.fixture(scope="module", autouse=True)
def _starts_are_shared() -> Iterator[None]:
    """Rows with one start on one scene look for its hollows once."""
    carve, known = initial.carved, {}

    def carved(hull: initial.Hull, cameras: list[Any], *rest: Any, **how: Any) -> initial.Hull:
        key = (cameras[0].name, cameras[0].width, hull.cells.tobytes(), how["volume_steps"])
        if key not in known:
            known[key] = carve(hull, cameras, *rest, **how)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initial, "carved", carved)
        yield


@needs_shared
@pytest.mark.parametrize(("row", "scene"), list(cells()))
def test_cell(row: str, scene: str, results: Path, tmp_path: Path) -> None:
    file = results / f"{row} {scene}.json"
    if not file.exists():
        file.write_text(json.dumps(trained(row, scene, tmp_path)))
    print(f"{row:24} {scene:8} {json.loads(file.read_text())}")


@needs_shared
def test_table(results: Path) -> None:
    """The cells of all calls as a table: foreground degrees and dB, and their means."""
    print("\n| row |", " | ".join(SCENES), "| mean |\n|---|", "---|" * (len(SCENES) + 1), sep="")
    for row in ROWS:
        files = [results / f"{row} {scene}.json" for scene in SCENES]
        found = [json.loads(file.read_text()) for file in files if file.exists()]
        if len(found) == len(files):
            mean = {key: statistics.fmean(cell[key] for cell in found) for key in found[0]}
            texts = [f"{c['degrees']:.2f}, {c['psnr']:.1f}" for c in (*found, mean)]
            print(f"| {row} |", " | ".join(texts), "|")


def trained(row: str, scene: str, folder: Path) -> dict[str, float]:
    """Train a cell and compare it with the held-out views."""
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "2")))
    name, changes = ROWS[row]
    base = Settings.of(recipe.load(name).tables)
    common = json.loads(os.environ.get("REFDGS_LADDER_SET", "{}"))
    params = base.but(**{**BUDGET, **common, **changes})
    stages = Stages(folder)
    views = stages.ingest(SHARED / "scenes" / scene)
    model = stages.sfm(views)

    def surface(field: SurfelField) -> TriangleMesh:
        draw, shape = partial(render_surface_map, field), ShapeParams()
        return own_surface(model, draw, None, shape, lambda c, _: c)

    before = time.process_time()
    field = trained_field(views, model, params, folder, surface=surface)
    return {
        **compared(field, views, model, SHARED / "scenes" / scene),
        "core_s": round(time.process_time() - before),
    }


def compared(field: SurfelField, views: Views, model: SparseModel, scene: Path) -> dict[str, float]:
    """Means over the held-out views of the scene in this folder: dB, degrees."""
    held_out = [camera for camera in model.cameras if camera.split == "test"][::EVERY]
    pictures, degrees, everywhere = [], [], []
    for camera in held_out:
        photo = load_photo(views, model, camera)
        assert photo.mask is not None
        mask = photo.mask[..., None]
        over_white = photo.rgb * mask + 1 - mask
        pictures.append(psnr(render_image(field, photo.camera), over_white))
        source = scene / views[camera.name].source
        truth = read_view_truth(view_truth_files(source))
        figures = compare_maps(render_surface_map(field, camera), replace(truth, depth=None))
        degrees.append(figures["normal_mae_foreground_deg"])
        everywhere.append(figures["normal_mae_deg"])
    return {
        "psnr": statistics.fmean(pictures),
        "degrees": statistics.fmean(degrees),
        "all_degrees": statistics.fmean(everywhere),
    }
