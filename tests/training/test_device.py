"""Training on a GPU, as far as it can be proved without one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from emulation import emulated
from torch import Tensor
from training.test_trainer import SMALL, capture, quiet

from refdgs_pipe.ops import cuda, cuda_rasterize
from refdgs_pipe.training import shading
from refdgs_pipe.training.photos import _shrunk_there, shrunk
from refdgs_pipe.training.trainer import Trainer

GPU = "meta"  # torch's device of tensors with sizes but no numbers: reading one raises
VARIANTS: list[tuple[dict[str, Any], bool]] = [
    ({"local_from": 0.0, "reflect_from": 0.0}, True),
    ({"local": "shared", "mixing": "sum", "reflect_from": 0.0}, True),
    ({"distortion_weight": 10.0, "smooth_weight": 0.1}, True),
    ({"local_from": 0.0}, False),
]


@contextmanager
def numberless_gpu() -> Iterator[None]:
    """A GPU without numbers: what mixes devices or waits for a number raises.

    Kernels do nothing; the two numbers that a step does wait for, how many entries and how many
    covered pixels there are, are made up.
    """

    def kernels(name: str, like: Tensor) -> Callable[..., list[int]]:
        assert like.device.type == GPU
        return lambda *arguments: [4096, 4096, 4096, 4096]

    def nonzero(tensor: Tensor) -> Tensor:
        return torch.zeros(70, 1, dtype=torch.int64, device=tensor.device)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda, "on_gpu", lambda tensor: tensor.device.type == GPU)
        patch.setattr(cuda, "kernels", kernels)
        patch.setattr(cuda, "processors", lambda like: 4)
        patch.setattr(cuda, "check_gpu", lambda name, tensor: None)
        patch.setattr(cuda_rasterize, "_entries", lambda *arguments: 300)
        patch.setattr(shading.torch, "nonzero", nonzero)
        adam = torch.optim.Adam
        patch.setattr(torch.optim, "Adam", lambda *a, **k: adam(*a, **{**k, "fused": False}))
        yield


@pytest.mark.parametrize(("changed", "masked"), VARIANTS)
def test_a_step_mixes_no_devices_and_waits_for_no_number(
    tmp_path: Path, changed: dict[str, Any], masked: bool
) -> None:
    views, model = capture(tmp_path / "views", masked=masked)
    params = SMALL.model_copy(update={"start": "ball", **changed})
    with numberless_gpu():
        trainer = Trainer(views, model, params, tmp_path, device=GPU)
        assert {p.device.type for p in trainer.field.geometry.raw.values()} == {GPU}
        assert trainer.full[0].rgb.device.type == GPU
        trainer._photo = lambda fraction: trainer.full[0]  # type: ignore[method-assign]
        for _ in range(3):
            trainer.step()
        assert trainer.field.geometry.gradient_sum.device.type == GPU


def test_training_with_the_emulated_kernels_goes_as_on_the_cpu(tmp_path: Path) -> None:
    """Also through densification, a checkpoint and the frozen field."""
    views, model = capture(tmp_path / "views", size=20)
    few = {
        "iterations": 7,
        "surfels": 150,
        "local_surfels": 100,
        "densify_every": 3,
        "start": "hull",
    }
    params = SMALL.model_copy(update={**few, "reflect_from": 0.0, "local_from": 0.3})
    fields = []
    for on in (False, True):
        folder = tmp_path / f"run-{on}"
        folder.mkdir()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("refdgs_pipe.training.trainer.REPORT_STEPS", 4)
            trainer = Trainer(views, model, params, folder)
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


@pytest.mark.parametrize("masked", [False, True])
def test_photos_shrink_on_the_gpu_as_on_the_cpu(tmp_path: Path, masked: bool) -> None:
    views, model = capture(tmp_path / "views", masked=masked)
    trainer = Trainer(views, model, SMALL, tmp_path)
    for width in (20, 32, 50):
        wanted = shrunk(trainer.full[0], width / 64)
        found = _shrunk_there(trainer.full[0], width, width)
        assert found.camera.width == wanted.camera.width == width
        step = (found.rgb.int() - wanted.rgb.int()).abs()
        assert int(step.max()) <= 1 and float(step.float().mean()) < 0.01
        if wanted.mask is not None and found.mask is not None:
            assert int((found.mask.int() - wanted.mask.int()).abs().max()) <= 1
