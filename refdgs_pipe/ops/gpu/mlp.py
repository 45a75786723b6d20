"""The shader's network on a GPU; nothing waits for it."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda

POINTS, HIDDEN = 64, 64  # points of a block's tile; width of hidden layers
BLOCKS_PER_PROCESSOR = 3
HALF_BLOCKS_PER_PROCESSOR = 2
HALF_LAYERS, HALF_INPUTS = 3, 15  # hidden layers, and most inputs, of the kernels for bfloat16
TENSOR_CORES = True  # for the network's hidden layers; else fused multiply-adds


def mlp(
    exp_cap: float | None,
    half: bool,
    limit: Tensor | None,
    threads: int,
    count: int,
    *tensors: Tensor,
) -> Tensor:
    """`ops.mlp`; inputs are checked there. Tables are read where they lie."""
    out: Tensor = Mlp.apply(exp_cap, half, limit, count, *tensors)  # type: ignore[no-untyped-call]
    return out


class Mlp(torch.autograd.Function):
    """Keeps the tables and the result; hidden values are computed again."""

    @staticmethod
    def forward(
        ctx: Any,
        exp_cap: float | None,
        half: bool,
        limit: Tensor | None,
        count: int,
        *tensors: Tensor,
    ) -> Tensor:
        tables, parameters = tensors[:count], [t.contiguous() for t in tensors[count:]]
        x, inputs = tables[0], sum(table.shape[1] for table in tables)
        layers, outputs = len(parameters) // 2, len(parameters[-1])
        half = half and TENSOR_CORES and layers - 1 == HALF_LAYERS and inputs <= HALF_INPUTS
        out = x.new_empty(len(x), outputs)
        each = HALF_BLOCKS_PER_PROCESSOR if half else BLOCKS_PER_PROCESSOR
        blocks = min(-(-len(x) // POINTS), each * cuda.processors(x))
        ctx.shape = [len(x), inputs, layers - 1, outputs, blocks, int(TENSOR_CORES), int(half)]
        ctx.cap, ctx.limit, ctx.tables = [] if exp_cap is None else [exp_cap], limit, count
        cuda.kernels("mlp", x)(*_call(ctx, tables, parameters), addresses.of(out))
        ctx.save_for_backward(out, *tables, *parameters)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        out, *tensors = ctx.saved_tensors
        tables, parameters = tensors[: ctx.tables], tensors[ctx.tables :]
        hidden_layers, blocks, half = ctx.shape[2], ctx.shape[4], ctx.shape[6]
        v_out, needed = grads[0].contiguous(), ctx.needs_input_grad[4 : 4 + ctx.tables]
        v_tables = [t.new_empty(t.shape) for t in tables] if any(needed) else []
        v_parameters = [torch.empty_like(t) for t in parameters]
        numbers = sum(t.numel() for t in parameters)
        kept = 0 if half else blocks * hidden_layers * HIDDEN * POINTS
        hidden = cuda.memory(kept * out.itemsize, out)
        parts = cuda.memory(blocks * numbers * out.itemsize, out)
        cuda.kernels("mlp_bwd", out)(
            *_call(ctx, tables, parameters),
            addresses.each((out, v_out, hidden, parts)),
            [addresses.sized_table(t) for t in v_tables],
            *addresses.halves(v_parameters),
        )
        wanted = [v if need else None for v, need in zip(v_tables, needed, strict=False)]
        wanted += [None] * (ctx.tables - len(wanted))
        return None, None, None, None, *wanted, *v_parameters


def _call(ctx: Any, tables: Sequence[Tensor], parameters: Sequence[Tensor]) -> tuple[Any, ...]:
    where = [addresses.sized_table(t) for t in tables]
    return ctx.shape, where, *addresses.halves(parameters), ctx.cap, addresses.of(ctx.limit)
