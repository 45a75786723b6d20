"""Training on a GPU, as far as it can be proved without one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from emulation import emulated
from lights import LIGHTS
from torch import Tensor
from training.test_trainer import SMALL, capture, quiet
from training_runs import trainer_of

from refdgs_pipe.ops import Plan, Readback, cuda
from refdgs_pipe.ops import plan as planning
from refdgs_pipe.ops.gpu import rasterize as drawing
from refdgs_pipe.ops.gpu import shade as shading
from refdgs_pipe.ops.registry import using
from refdgs_pipe.training.photos import _shrunk_there, shrunk
from refdgs_pipe.training.trainer import Moment, Trainer

pytestmark = pytest.mark.usefixtures("coarse_start")

GPU = "meta"  # torch's device of tensors with sizes but no numbers: reading one raises
VARIANTS: list[tuple[dict[str, Any], bool]] = [
    ({"local_from": 0.0, "reflect_from": 0.0}, True),
    ({"local": "shared", "mixing": "sum", "reflect_from": 0.0}, True),
    ({"distortion_weight": 10.0, "smooth_weight": 0.1}, True),
    ({"local_from": 0.0}, False),
    ({"light": "turntable", "reflect_from": 0.0}, True),
    ({"light": "flash", "reflect_from": 0.0}, True),
]


@contextmanager
def numberless_gpu() -> Iterator[None]:
    """A GPU without numbers: what mixes devices or waits for a number raises.

    Kernels do nothing; the numbers that only the first steps wait for, how many entries and how
    many covered pixels there are, are made up. What a step sends to the CPU is dropped.
    """

    def kernels(name: str, like: Tensor) -> Callable[..., list[int]]:
        assert like.device.type == GPU
        return lambda *arguments: [4096] * 5

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda, "kernels", kernels)
        patch.setattr(cuda, "processors", lambda like: 4)
        patch.setattr(cuda, "check_gpu", lambda name, tensor: None)
        patch.setattr(drawing, "_entries", lambda *arguments: 300)
        patch.setattr(shading, "_count", lambda *arguments: 70)
        patch.setattr(Readback, "send", lambda *arguments: None)
        adam = torch.optim.Adam
        patch.setattr(torch.optim, "Adam", lambda *a, **k: adam(*a, **{**k, "fused": False}))
        with using("gpu"):
            yield


def _waits(*arguments: object) -> int:
    raise AssertionError("a step waits for the GPU")


@pytest.mark.parametrize(("changed", "masked"), VARIANTS)
def test_a_step_mixes_no_devices_and_waits_for_no_number(
    tmp_path: Path, changed: dict[str, Any], masked: bool
) -> None:
    views, model = capture(tmp_path / "views", masked=masked)
    changed = dict(changed)
    light = LIGHTS[changed.pop("light", "world")]
    params = SMALL.but(**{"masked": "ball", **changed})
    with numberless_gpu():
        trainer = trainer_of(views, model, params, tmp_path, device=GPU, lighting=light)
        assert {p.device.type for p in trainer.field.geometry.raw.values()} == {GPU}
        assert trainer.full[0].rgb.device.type == GPU
        trainer._photo = lambda fraction: trainer.full[0]  # type: ignore[method-assign]
        for _ in range(3):
            trainer.step()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(drawing, "_entries", _waits)
            patch.setattr(shading, "_count", _waits)
            for _ in range(3):
                trainer.step()
        assert trainer.field.geometry.gradient_sum.device.type == GPU


@pytest.mark.parametrize("light", LIGHTS)
def test_training_with_the_emulated_kernels_goes_as_on_the_cpu(tmp_path: Path, light: str) -> None:
    """Also through densification, a checkpoint and the frozen field."""
    views, model = capture(tmp_path / "views", size=20)
    few = {
        "iterations": 7,
        "surfels": 150,
        "local_surfels": 100,
        "densify_every": 3,
        "masked": "hull",
    }
    params = SMALL.but(**{**few, "reflect_from": 0.0, "local_from": 0.3})
    fields = []
    for on in (False, True):
        folder = tmp_path / f"run-{on}"
        folder.mkdir()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("refdgs_pipe.training.trainer.REPORT_STEPS", 4)
            trainer = trainer_of(views, model, params, folder, lighting=LIGHTS[light])
            run = partial(trainer.run, quiet)
            if on:
                with emulated():
                    field = run()
            else:
                field = run()
        fields.append((field, trainer.loss))
    (wanted, loss), (found, other) = fields
    assert len(found.geometry) == len(wanted.geometry)
    # Adam amplifies rounding where gradients are tiny
    assert float(abs(found.geometry.means - wanted.geometry.means).mean()) < 1e-3
    assert other == pytest.approx(loss, rel=2e-3)


def trained(
    folder: Path, plan: Plan | None, steps: int, light: str = "world", **changed: Any
) -> Trainer:
    """A short training with the emulated kernels, read two steps late where there is a plan."""
    views, model = capture(folder / "views", size=20)
    few = {"iterations": steps, "surfels": 150, "local_surfels": 100, "masked": "hull"}
    params = SMALL.but(**{**few, "reflect_from": 0.0, "local_from": 0.3, **changed})
    trainer = trainer_of(views, model, params, folder, lighting=LIGHTS[light])
    if plan is not None:
        trainer.plan, trainer._later = plan, Readback("cpu", lag=2)
    with emulated():
        for _ in range(steps):
            trainer.step()
        trainer._read(all_of_them=True)
    return trainer


@pytest.mark.parametrize("light", LIGHTS)
def test_training_with_planned_lists_ends_in_the_same_bits(tmp_path: Path, light: str) -> None:
    few = {"densify_every": 3, "smooth_weight": 0.1}
    wanted = trained(tmp_path / "a", None, 8, light, **few)
    found = trained(tmp_path / "b", Plan("cpu"), 8, light, **few)
    assert len(found.field.geometry) > 0
    if light != "world":  # sums over all pixels are rounded otherwise if more rows are zero
        assert found.loss == pytest.approx(wanted.loss, rel=1e-3)
        assert wanted.field.light is not None and found.field.light is not None
        values = wanted.field.light.parameters(), found.field.light.parameters()
        assert all(torch.allclose(a, b, atol=1e-3) for a, b in zip(*values, strict=True))
        return
    assert found.loss == wanted.loss
    for name, value in wanted.field.state().items():
        assert torch.equal(found.field.state()[name], value), name


def test_a_step_whose_lists_have_no_room_changes_nothing_and_is_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "LEAST", 1)
    monkeypatch.setattr(planning, "LADDER", 1.01)
    monkeypatch.setattr(planning, "MARGIN", 1.0)  # the next view may need more
    plan, noted, misfits = Plan("cpu"), [], []
    learn, update = plan.learn, Trainer._update

    def watched(trainer: Trainer, moment: Moment) -> None:
        before = {k: v.clone() for k, v in trainer.field.state().items()}
        update(trainer, moment)
        if float(plan.misfit):
            misfits.append(moment.iteration)
            for name, value in trainer.field.state().items():
                assert torch.equal(before.get(name, torch.zeros_like(value)), value), name

    def learned(asked: Any, needed: Tensor) -> bool:
        noted.append(learn(asked, needed))
        return noted[-1]

    monkeypatch.setattr(Trainer, "_update", watched)
    monkeypatch.setattr(plan, "learn", learned)
    trainer = trained(tmp_path, plan, 10, densify_every=100)
    assert misfits and noted.count(False) == len(misfits) and noted.count(True) == 10
    steps = {float(s["step"]) for s in trainer.field.geometry.optimizer.state.values()}
    assert steps == {10.0}


@pytest.mark.parametrize("masked", [False, True])
def test_photos_shrink_on_the_gpu_as_on_the_cpu(tmp_path: Path, masked: bool) -> None:
    views, model = capture(tmp_path / "views", masked=masked)
    trainer = trainer_of(views, model, SMALL, tmp_path)
    for width in (20, 32, 50):
        wanted = shrunk(trainer.full[0], width / 64)
        found = _shrunk_there(trainer.full[0], width, width)
        assert found.camera.width == wanted.camera.width == width
        step = (found.rgb.int() - wanted.rgb.int()).abs()
        assert int(step.max()) <= 1 and float(step.float().mean()) < 0.01
        if wanted.mask is not None and found.mask is not None:
            assert int((found.mask.int() - wanted.mask.int()).abs().max()) <= 1
