"""The update of every parameter after a step."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from refdgs_pipe.ops.gpu import adam as on_gpu
from refdgs_pipe.ops.registry import Operation


def _each_steps(
    optimizers: Sequence[torch.optim.Adam], misfit: Tensor | None, rates: Tensor | None
) -> None:
    """Torch's own steps."""
    for optimizer in optimizers:
        optimizer.step()


_ADAM_STEP = Operation("adam_step", _each_steps, _each_steps, on_gpu.adam_step)


def adam_step(
    optimizers: Sequence[torch.optim.Adam],
    misfit: Tensor | None = None,
    rates: Tensor | None = None,
) -> None:
    """What each optimiser's `step` does, on its own state.

    On a GPU it is one launch for many tensors, which nothing waits for, and all optimisers must
    have torch's default betas and one epsilon.

    Args:
        misfit: () on a GPU; where it is 1 nothing changes.
        rates: (T,) on a GPU, read when the step is run: those of all tensors, in the order of
            `rates_of`, instead of what the optimisers say now.
    """
    if optimizers:
        first = optimizers[0].param_groups[0]["params"][0]
        _ADAM_STEP.kernel(first)(optimizers, misfit, rates)


def rates_of(optimizers: Iterable[torch.optim.Adam]) -> list[float]:
    """The step of every tensor of every optimiser."""
    groups = [group for optimizer in optimizers for group in optimizer.param_groups]
    return [group["lr"] for group in groups for _ in group["params"]]
