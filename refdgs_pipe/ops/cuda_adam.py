"""Adam on a GPU: every tensor of every optimiser in one launch; nothing waits for it."""

from collections.abc import Iterable

import torch
from torch import Tensor

from refdgs_pipe.ops import cuda

TENSORS = 32  # of one launch


def adam_step(
    optimizers: Iterable[torch.optim.Adam], misfit: Tensor | None, rates: Tensor | None = None
) -> None:
    """What each optimiser's `step` does, on its own state; nothing where `misfit` () is 1.

    All optimisers have torch's default betas and one epsilon.

    Args:
        rates: (T,) on the GPU, read when the step is run: those of all tensors, in the order of
            `rates_of`, instead of what the optimisers say now.
    """
    rows: list[tuple[Tensor, Tensor, dict[str, Tensor], int, float]] = []
    index, epsilon, betas = -1, 0.0, (0.0, 0.0)
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            epsilon, betas = group["eps"], group["betas"]
            for values in group["params"]:
                index += 1
                if values.grad is not None:
                    state = optimizer.state[values] or _begin(optimizer, values)
                    rate_at = 0 if rates is None else rates.data_ptr() + rates.itemsize * index
                    rows.append((values, values.grad.contiguous(), state, rate_at, group["lr"]))
    for first in range(0, len(rows), TENSORS):
        some = rows[first : first + TENSORS]
        addresses = [
            address
            for values, grad, state, rate_at, _ in some
            for address in (
                *(t.data_ptr() for t in (values, grad, state["exp_avg"], state["exp_avg_sq"])),
                state["step"].data_ptr(),
                rate_at,
            )
        ]
        cuda.kernels("adam", some[0][0])(
            addresses,
            [values.numel() for values, *_ in some],
            [rate for *_, rate in some],
            [*betas, epsilon],
            0 if misfit is None else misfit.data_ptr(),
        )


def rates_of(optimizers: Iterable[torch.optim.Adam]) -> list[float]:
    """The step of every tensor of every optimiser."""
    groups = [group for optimizer in optimizers for group in optimizer.param_groups]
    return [group["lr"] for group in groups for _ in group["params"]]


def _begin(optimizer: torch.optim.Adam, values: Tensor) -> dict[str, Tensor]:
    """The state that torch's own step would make."""
    state: dict[str, Tensor] = optimizer.state[values]
    state["step"] = torch.zeros((), dtype=torch.float32, device=values.device)
    state["exp_avg"] = torch.zeros_like(values, memory_format=torch.contiguous_format)
    state["exp_avg_sq"] = torch.zeros_like(values, memory_format=torch.contiguous_format)
    return state
