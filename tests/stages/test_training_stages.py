"""The stages of training: what they pass on, and what a changed setting makes again."""

import json
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import finished
import numpy as np
import pytest
import torch
from lights import LIGHTS
from stage_runs import NO_MASKS
from training.test_trainer import SMALL, capture, quiet
from training_runs import Settings, trainer_of

from refdgs_pipe import recipe
from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.artifacts.lighting import WORLD
from refdgs_pipe.artifacts.shape import Shape
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.pipeline import catalog
from refdgs_pipe.pipeline.events import Event, Measured, Sampled, Warned
from refdgs_pipe.pipeline.fingerprint import Fingerprint
from refdgs_pipe.pipeline.plan import Pipeline
from refdgs_pipe.pipeline.stage import Artifact, Job
from refdgs_pipe.pipeline.store import Record, Store
from refdgs_pipe.training.settings import TrainParams

MARK = Fingerprint("photos", {})


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def all_made(tmp_path_factory: pytest.TempPathFactory) -> Pipeline:
    """A workspace in which every stage has a result of the defaults."""
    pipeline, digests = catalog.build(Store(tmp_path_factory.mktemp("work"))), dict[type, str]()
    digests[pipeline.source] = MARK.digest
    settings = settings_of(pipeline)
    for stage in pipeline.stages:
        origin = pipeline.step(stage, digests, settings, MARK).origin
        assert origin is not None
        folder = pipeline.store.partial(origin)
        (folder / "result").write_text(stage.name)
        manifest = pipeline.store.commit(folder, origin, Record(1.0, {}))
        digests[stage.output] = manifest.digest
    return pipeline


def settings_of(pipeline: Pipeline, *assignments: str) -> Any:
    models = {stage.name: stage.params for stage in pipeline.stages}
    return recipe.resolve(recipe.load("glossy"), assignments, models)


@pytest.mark.parametrize(
    ("changed", "first"),
    [
        ("refine.surfels=1.2", "refine"),
        ("refine.turning=0.5", "refine"),
        ("shape.voxel=0.005", "shape"),
        ("train.rate_means=1e-3", "train"),
        ("train.anneal_to=0.1", "train"),
        ("train.normal_weight=0.1", "train"),
        ("train.max_surfels=50000", "train"),
        ("start.volume_steps=7", "start"),
        ("extract.voxel=0.005", "extract"),
    ],
)
def test_a_changed_setting_makes_only_its_stage_and_what_follows_again(
    all_made: Pipeline, changed: str, first: str
) -> None:
    steps = all_made.status(MARK, settings_of(all_made, changed))
    names = [step.stage.name for step in steps]
    valid = [step.stage.name for step in steps if step.state == "up to date"]
    assert valid[: names.index(first)] == names[: names.index(first)]
    assert first not in valid and "evaluate" not in valid


class Stages:
    """Runs the stages of training as the engine does, by way of the disk."""

    def __init__(self, folder: Path, settings: Settings, *, masked: bool) -> None:
        self.folder, self.settings, self.told = folder, settings, list[Event]()
        self.views, self.model = capture(folder / "views", size=32, masked=masked)
        self.lighting = WORLD

    def __call__(self, name: str, params: Any, *inputs: Artifact) -> Any:
        stage = getattr(import_module(f"refdgs_pipe.stages.{name}"), name)
        out, scratch = self.folder / name, self.folder / f"scratch-{name}"
        for path in (out, scratch):
            path.mkdir(exist_ok=True)
        job = Job(name, out, scratch, "cpu", 1, self.told.append)
        stage.run(*inputs, params, job).save(out)
        return stage.output.load(out)

    def field(self, change: Callable[[Shape], Shape] = lambda shape: shape) -> SurfelField:
        photos = (self.views, NO_MASKS, self.model)
        start: Start = self("start", self.settings.start, *photos)
        before: Checkpoint = self("train", self.settings.train, *photos, self.lighting, start)
        shape: Shape = change(self("shape", stage_params("shape"), before, self.model))
        found: SurfelField = self(
            "refine", self.settings.refine, *photos, self.lighting, start, before, shape
        )
        return found

    def warnings(self) -> list[str]:
        return [event.text for event in self.told if isinstance(event, Warned)]


def stage_params(name: str) -> Any:
    return getattr(import_module(f"refdgs_pipe.stages.{name}"), name).params()


FEW = SMALL.but(iterations=24, surfels=300, local_surfels=80, densify_every=6, look_steps=12)


def assert_equal(one: SurfelField, other: SurfelField) -> None:
    for name in ("geometry", "local", "background"):
        ours, theirs = getattr(one, name), getattr(other, name)
        for kind in ("means", "quats", "scales", "opacities"):
            np.testing.assert_array_equal(getattr(ours, kind), getattr(theirs, kind))
        for kind, values in ours.values.items():
            np.testing.assert_array_equal(values, theirs.values[kind])
    np.testing.assert_array_equal(one.shader.environment, other.shader.environment)
    assert one.poses.keys() == other.poses.keys()
    for name, pose in one.poses.items():
        np.testing.assert_array_equal(pose, other.poses[name])


@pytest.mark.parametrize(
    ("changed", "masked"),
    [
        ({}, True),
        ({"patience": 0.1, "patience_tolerance": 10.0, "coarse_until": 0.1}, True),
        ({"exposure": "fitted", "poses": "refined", "ground": "object"}, False),
        ({"light": "turntable"}, True),
        ({"light": "flash"}, True),
    ],
)
def test_training_in_two_stages_ends_in_the_same_bits_as_in_one(
    tmp_path: Path, changed: dict[str, Any], masked: bool
) -> None:
    """Without a mesh to start anew on, the second part only goes on."""
    changed = dict(changed)
    light = LIGHTS[changed.pop("light", "world")]
    settings = FEW.but(**changed, renew_at=0.6)
    stages = Stages(tmp_path, settings, masked=masked)
    stages.lighting = light
    if "poses" in changed:  # they are refined if they were found
        found = tuple(replace(view, known=None) for view in stages.views.items)
        stages.views = replace(stages.views, items=found)
    parts = stages.field(lambda shape: Shape(None, "none was asked for"))
    assert stages.warnings()[0].endswith("none was asked for")
    at_once = settings.but(renew_at=1.0)
    whole = trainer_of(stages.views, stages.model, at_once, tmp_path / "whole", lighting=light).run(
        quiet
    )
    assert_equal(parts, whole)
    assert parts.lighting.record() == whole.lighting.record()
    if light.kind != "world":  # it was fitted
        assert parts.lighting.record() != light.record()
    steps = [event.step for event in stages.told if isinstance(event, Sampled)]
    assert steps == sorted(set(steps)) and len(steps) >= 3


def test_a_field_that_is_through_is_not_meshed_and_passed_on(tmp_path: Path) -> None:
    stages = Stages(tmp_path, FEW.but(renew_at=1.0), masked=True)
    field = stages.field()
    assert not (tmp_path / "shape" / "mesh.ply").exists()
    assert_equal(field, Checkpoint.load(tmp_path / "train").field)
    told = {e.name: e.value for e in stages.told if isinstance(e, Measured) and e.stage == "refine"}
    assert told["steps"] == 24 and told["surfels"] == len(field.geometry)
    assert {"object shown", "loss", "train PSNR"} <= told.keys()


def test_what_passes_between_the_stages_is_the_same_after_the_disk(tmp_path: Path) -> None:
    start = finished.start()
    start.save(tmp_path)
    again = Start.load(tmp_path)
    for name, values in start.geometry.items():
        np.testing.assert_array_equal(values, again.geometry[name])
    np.testing.assert_array_equal(again.covers["a"], start.covers["a"])
    assert again.background is None
    assert (again.seed, again.ground, again.ball.radius) == (3, "background", 1.2)
    before = finished.checkpoint()
    before.save(tmp_path)
    found = Checkpoint.load(tmp_path)
    assert found.tensors["geometry/adam.means.step"].shape == ()
    assert (found.figures, found.settings) == (before.figures, before.settings)
    Shape(None, "no views").save(tmp_path)
    assert Shape.load(tmp_path) == Shape(None, "no views")


@pytest.mark.parametrize(
    ("kind", "make", "file"),
    [
        (Start, finished.start, "start.json"),
        (Start, finished.start, "start.safetensors"),
        (Checkpoint, finished.checkpoint, "state.json"),
        (Checkpoint, finished.checkpoint, "state.safetensors"),
        (Shape, lambda: Shape(None), "shape.json"),
    ],
)
def test_a_damaged_file_is_named_with_its_stage(
    tmp_path: Path, kind: Any, make: Callable[[], Any], file: str
) -> None:
    make().save(tmp_path)
    (tmp_path / file).write_text(json.dumps({"seed": 1}))
    with pytest.raises(CorruptError, match=r"run the stage \w+ again"):
        kind.load(tmp_path)


def test_a_start_gives_up_surfels_evenly_where_memory_is_short() -> None:
    small = finished.start().limited(surfels=2, local=4, background=5)
    np.testing.assert_array_equal(small.geometry["means"], [[0, 0, 1], [0, 1, 1]])
    assert len(small.local["means"]) == 4
    assert (small.surfels, small.background_surfels) == (2, 5)


def test_the_settings_of_a_checkpoint_are_all_of_them(tmp_path: Path) -> None:
    stages = Stages(tmp_path, FEW.but(iterations=3, renew_at=0.5), masked=True)
    start = stages("start", stages.settings.start, stages.views, NO_MASKS, stages.model)
    photos = (stages.views, NO_MASKS, stages.model)
    before = stages("train", stages.settings.train, *photos, WORLD, start)
    assert TrainParams.model_validate(before.settings) == stages.settings.train
