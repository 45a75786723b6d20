"""Planning for a GPU's memory, and what happens when it runs out."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from finished import start

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import DeviceError
from refdgs_pipe.training import budget
from refdgs_pipe.training.settings import StartParams, TrainParams

PARAMS = TrainParams()
START = replace(start(), max_side=800, surfels=20_000, background_surfels=60_000)
LOAD = budget.Load(PARAMS, START, growth=1.7)


def model_of(width: int, height: int, count: int = 100) -> SparseModel:
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    cameras = tuple(Camera(f"v{i}", width, height, K, np.eye(4), "train") for i in range(count))
    ball, up = Ball(np.zeros(3), 1.0), np.array([0.0, 0, 1])
    none = np.zeros((0, 3))
    return SparseModel(cameras, {}, none, none.astype(np.uint8), {}, ball, up, np.eye(4), None, ())


def load_of(**changes: int) -> budget.Load:
    caps = {name: changes.pop(name) for name in tuple(changes) if name in TrainParams.model_fields}
    begun = replace(START, **changes)  # type: ignore[arg-type]
    return replace(LOAD, params=PARAMS.model_copy(update=caps), start=begun)


def test_more_pixels_and_surfels_need_more() -> None:
    small, large = model_of(400, 300), model_of(800, 600)
    assert budget.need_of(LOAD, small).pixels < budget.need_of(LOAD, large).pixels
    more = load_of(max_surfels=2 * PARAMS.max_surfels)
    assert budget.need_of(LOAD, small).surfels < budget.need_of(more, small).surfels


def test_settings_that_fit_stay_as_they_are() -> None:
    assert budget.fitted(LOAD, model_of(800, 800), 8 * 10**9) == LOAD


def test_steps_are_recorded_only_where_that_costs_nothing_else() -> None:
    model = model_of(800, 800)
    without = replace(LOAD, cuda_graph=False)
    alone = budget.need_of(without, model).total
    fitting = budget.fitted(LOAD, model, alone)
    assert fitting == without
    assert budget.changes(LOAD, fitting) == "steps are not recorded"
    insists = replace(LOAD, cuda_graph=True)
    assert budget.fitted(insists, model, alone).cuda_graph is True


def test_what_takes_more_is_lowered_first() -> None:
    model = model_of(800, 800)
    many = load_of(max_surfels=2_000_000)
    fitting = budget.fitted(many, model, 3 * 10**9)
    assert fitting.start.max_side == many.start.max_side
    assert fitting.params.max_surfels < 10**6
    assert budget.need_of(fitting, model).total <= 3 * 10**9
    wide = model_of(8000, 6000, 400)
    sharp = load_of(max_side=8000)
    fitting = budget.fitted(sharp, wide, 8 * 10**9)
    assert fitting.start.max_side < 8000
    assert fitting.params.max_surfels == sharp.params.max_surfels


def test_a_budget_below_the_least_is_an_error_that_says_what_to_do() -> None:
    with pytest.raises(DeviceError, match=r"may use 0\.5 GB: give more by --vram"):
        budget.fitted(LOAD, model_of(800, 800), 500_000_000)


def test_the_limit_and_the_free_memory_both_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    free = 100 * 10**9
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (free, free))
    many = load_of(max_surfels=2_000_000)
    model = model_of(800, 800)
    assert budget.planned(many, model, vram=0, warn=said.append) == many and not said
    limited = budget.planned(many, model, vram=2 * 10**9, warn=said.append)
    assert budget.need_of(limited, model).total <= 2 * 10**9
    assert said[0].startswith("2.0 GB of GPU memory: ")
    free = 2 * 10**9
    planned = budget.planned(many, model, vram=50 * 10**9, warn=said.append)
    assert planned.params.max_surfels < 10**6


class Hungry:
    """Runs out of memory until an image is small enough."""

    def __init__(self, load: budget.Load) -> None:
        self.load, self.params, self.side = load, load.params, load.start.max_side

    def run(self, progress: object) -> str:
        if self.side > 600 or self.params.max_surfels > 50_000:
            raise torch.cuda.OutOfMemoryError("no more")
        return "field"


def test_running_out_of_memory_lowers_settings_and_says_so() -> None:
    said: list[str] = []
    trainer, field = budget.train_within(Hungry, LOAD, print, said.append)  # type: ignore
    assert field == "field" and trainer.load.start.max_side <= 600
    assert said[0].startswith("the GPU's memory ran out: training at 578 instead of 800 pixels, ")
    assert trainer.load.cuda_graph is False
    assert "instead of 60000 surfels" in said[1]


def test_running_out_for_good_is_an_error() -> None:
    class Starving(Hungry):
        def run(self, progress: object) -> str:
            raise torch.cuda.OutOfMemoryError("no more")

    with pytest.raises(DeviceError, match="runs out even at"):
        budget.train_within(Starving, LOAD, print, lambda text: None)  # type: ignore


def test_a_first_look_that_runs_out_of_memory_is_at_smaller_pictures() -> None:
    said: list[str] = []

    def look(params: StartParams) -> float:
        if params.look_scale > 0.4:
            raise torch.cuda.OutOfMemoryError("no more")
        return params.look_scale

    assert 0.3 < budget.start_within(look, StartParams(), said.append) <= 0.4
    assert said[0].endswith("the first look is at 0.42 of the photos' size") and len(said) == 2


def test_a_start_has_no_more_surfels_than_there_is_memory_for() -> None:
    smaller = budget._smaller(replace(LOAD, start=replace(START, max_side=256)), pixels=False)
    assert smaller.params.max_surfels < PARAMS.max_surfels
    assert smaller.start.surfels == 15_000 and smaller.start.background_surfels == 45_000
