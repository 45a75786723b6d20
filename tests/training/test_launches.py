"""How much work a default step puts on a GPU's queue."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from emulation import emulated
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from training.test_trainer import SMALL, capture
from training_runs import trainer_of

from refdgs_pipe.ops import Plan, Readback
from refdgs_pipe.training.step import take_step

pytestmark = pytest.mark.usefixtures("coarse_start")

# Operations that only describe memory, and the emulator's filling of it
FREE = {
    "_reshape_alias", "_unsafe_view", "alias", "as_strided", "detach", "empty", "expand", "fill_",
    "full", "permute", "reshape", "select", "slice", "split", "split_with_sizes", "squeeze", "t",
    "transpose", "unbind", "unsqueeze", "view",
    "_record_function_enter_new", "_record_function_exit",
}  # fmt: skip
MOST = 60


class Launches(TorchDispatchMode):
    """Counts torch's operations; those in float64 are a camera's, on the CPU."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        out = function(*args, **(kwargs or {}))
        name = function.overloadpacket.__name__
        on_cpu = any(isinstance(t, Tensor) and t.dtype == torch.float64 for t in (*args, out))
        if name not in FREE and not on_cpu:
            self.found[name] += 1
        return out


def test_a_default_step_takes_few_launches(tmp_path: Path) -> None:
    module = pytest.importorskip("_refdgs_emulated")
    views, model = capture(tmp_path / "views", size=20)
    few = {"iterations": 10, "surfels": 100, "local_surfels": 60, "masked": "ball"}
    params = SMALL.but(**few, reflect_from=0.0, local_from=0.0)
    trainer = trainer_of(views, model, params, tmp_path)
    trainer.plan, trainer._later = Plan("cpu"), Readback("cpu", lag=2)
    backdrop = torch.rand(3)
    with emulated():
        for _ in range(2):  # the first one counts and waits
            before, launches = module.launches(), Launches()
            with launches:
                take_step(trainer.field, trainer.full[0], backdrop, 0.5, plan=trainer.plan)
    kernels = module.launches() - before
    assert kernels + launches.found.total() <= MOST, (kernels, launches.found)
    # torch's own: gradients of roughness by the network and by Sph-Mip, those of radiance by two
    # terms, and that a step begins
    assert launches.found.total() <= 3, launches.found
