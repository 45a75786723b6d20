"""The field in a checkpoint, as a viewer reads it while training goes on."""

from pathlib import Path

import numpy as np
import pytest
import torch
from lights import LIGHTS
from training.test_trainer import SMALL, capture
from training_runs import trainer_of

from refdgs_pipe.artifacts.lighting import WORLD, Lighting
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.training.checkpoint import NAME
from refdgs_pipe.training.render import render_surface_map
from refdgs_pipe.training.trainer import Trainer
from refdgs_pipe.training.unfinished import unfinished_field

FEW = {"surfels": 300, "local_surfels": 200, "masked": "hull"}
SOON = {"reflect_from": 0.0, "local_from": 0.2}


def stopped(folder: Path, steps: int, *, lighting: Lighting = WORLD, **changes: object) -> Trainer:
    """A training of ten steps that was stopped after some, with its checkpoint."""
    torch.set_num_threads(1)
    views, model = capture(folder / "views", size=24, masked=bool(changes.pop("with_masks", True)))
    params = SMALL.but(**{"iterations": 10, **FEW, **changes})
    trainer = trainer_of(views, model, params, folder, lighting=lighting)
    for _ in range(steps):
        trainer.step()
    trainer.save()
    return trainer


@pytest.mark.parametrize(
    "changes",
    [
        SOON,
        {**SOON, "local": "none"},
        {**SOON, "local": "shared", "mixing": "sum"},
        {**SOON, "mixing": "sum", "physical": False},
        {**SOON, "lighting": LIGHTS["flash"]},
        {**SOON, "lighting": LIGHTS["turntable"]},
        {"reflection": False},
        {**SOON, "with_masks": False},
    ],
    ids=lambda changes: " ".join(sorted(changes)),
)
def test_a_checkpoint_is_drawn_as_the_field_that_it_was_made_of(
    tmp_path: Path, changes: dict[str, object]
) -> None:
    trainer = stopped(tmp_path, 5, **changes)
    lighting = changes.get("lighting", WORLD)
    assert isinstance(lighting, Lighting)
    field, camera = trainer.frozen(), trainer.model.cameras[2]
    read = unfinished_field(tmp_path / NAME, field.near, lighting)
    expected = render_surface_map(field, camera).color
    np.testing.assert_array_equal(render_surface_map(read, camera).color, expected)


def test_reflections_that_training_has_not_reached_are_not_drawn(tmp_path: Path) -> None:
    trainer = stopped(tmp_path, 2, reflect_from=0.5)
    read = unfinished_field(tmp_path / NAME, trainer.field.near, WORLD)
    assert not read.shader.reflection
    assert len(read.local) == 0


def test_a_torn_checkpoint_is_named(tmp_path: Path) -> None:
    trainer = stopped(tmp_path, 1)
    path = tmp_path / NAME
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(CorruptError, match="not a readable checkpoint"):
        unfinished_field(path, trainer.field.near, WORLD)
