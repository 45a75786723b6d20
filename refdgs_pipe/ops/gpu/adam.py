"""Adam on a GPU: every tensor of every optimiser in one launch; nothing waits for it."""

from collections.abc import Iterable

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda

TENSORS = 32  # of one launch


def adam_step(
    optimizers: Iterable[torch.optim.Adam], misfit: Tensor | None, rates: Tensor | None
) -> None:
    """`ops.adam_step`; all optimisers have torch's default betas and one epsilon."""
    rows: list[tuple[Tensor, Tensor, dict[str, Tensor], int, float]] = []
    index, epsilon, betas = -1, 0.0, (0.0, 0.0)
    for optimizer in optimizers:
        for group in optimizer.param_groups:
            epsilon, betas = group["eps"], group["betas"]
            for values in group["params"]:
                index += 1
                if values.grad is not None:
                    state = optimizer.state[values] or _begin(optimizer, values)
                    rate_at = addresses.element(rates, index)
                    rows.append((values, values.grad.contiguous(), state, rate_at, group["lr"]))
    for first in range(0, len(rows), TENSORS):
        some = rows[first : first + TENSORS]
        where = [
            address
            for values, grad, state, rate_at, _ in some
            for address in (
                *addresses.each(
                    (values, grad, state["exp_avg"], state["exp_avg_sq"], state["step"])
                ),
                rate_at,
            )
        ]
        cuda.kernels("adam", some[0][0])(
            where,
            [values.numel() for values, *_ in some],
            [rate for *_, rate in some],
            [*betas, epsilon],
            addresses.of(misfit),
        )


def _begin(optimizer: torch.optim.Adam, values: Tensor) -> dict[str, Tensor]:
    """The state that torch's own step would make."""
    state: dict[str, Tensor] = optimizer.state[values]
    state["step"] = torch.zeros((), dtype=torch.float32, device=values.device)
    state["exp_avg"] = torch.zeros_like(values, memory_format=torch.contiguous_format)
    state["exp_avg_sq"] = torch.zeros_like(values, memory_format=torch.contiguous_format)
    return state
