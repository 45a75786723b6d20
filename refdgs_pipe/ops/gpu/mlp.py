"""The shader's network on a GPU; nothing waits for it."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda

POINTS, HIDDEN = 64, 64  # points of a block's tile; width of hidden layers
BLOCKS_PER_PROCESSOR = 3
TENSOR_CORES = True  # for the network's hidden layers; else fused multiply-adds


def mlp(
    exp_cap: float | None,
    half: bool,
    limit: Tensor | None,
    threads: int,
    count: int,
    *tensors: Tensor,
) -> Tensor:
    """`ops.mlp`; inputs are checked there. Tables are laid side by side first."""
    x = torch.cat(tensors[:count], 1) if count > 1 else tensors[0]
    out: Tensor = Mlp.apply(exp_cap, limit, x, *tensors[count:])  # type: ignore[no-untyped-call]
    return out


class Mlp(torch.autograd.Function):
    """Keeps x and the result; hidden values are computed again."""

    @staticmethod
    def forward(
        ctx: Any, exp_cap: float | None, limit: Tensor | None, x: Tensor, *parameters: Tensor
    ) -> Tensor:
        parameters = tuple(t.contiguous() for t in parameters)
        layers, outputs = len(parameters) // 2, len(parameters[-1])
        out = x.new_empty(len(x), outputs)
        tiles = -(-len(x) // POINTS)
        blocks = min(tiles, BLOCKS_PER_PROCESSOR * cuda.processors(x))
        ctx.shape = [*x.shape, layers - 1, outputs, blocks, int(TENSOR_CORES)]
        ctx.cap, ctx.limit = [] if exp_cap is None else [exp_cap], limit
        cuda.kernels("mlp", x)(*_call(ctx, x, parameters), addresses.of(out))
        ctx.save_for_backward(x, out, *parameters)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, out, *parameters = ctx.saved_tensors
        hidden_layers, blocks = ctx.shape[2], ctx.shape[4]
        v_out = grads[0].contiguous()
        v_x = x.new_empty(x.shape) if ctx.needs_input_grad[2] else None
        v_parameters = [torch.empty_like(t) for t in parameters]
        numbers = sum(t.numel() for t in parameters)
        hidden = cuda.memory(blocks * hidden_layers * HIDDEN * POINTS * x.itemsize, x)
        parts = cuda.memory(blocks * numbers * x.itemsize, x)
        cuda.kernels("mlp_bwd", x)(
            *_call(ctx, x, parameters),
            addresses.each((out, v_out, v_x, hidden, parts)),
            *addresses.halves(v_parameters),
        )
        return None, None, v_x, *v_parameters


def _call(ctx: Any, x: Tensor, parameters: Sequence[Tensor]) -> tuple[Any, ...]:
    head = (ctx.shape, addresses.of(x), list(x.stride()), *addresses.halves(parameters), ctx.cap)
    return *head, addresses.of(ctx.limit)
