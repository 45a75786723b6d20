"""The shader's network on the CPU."""

from collections.abc import Sequence
from typing import Any

import _refdgs_native as native
import torch
from torch import Tensor

from refdgs_pipe.ops import addresses
from refdgs_pipe.ops.native import kernels

MOST_KEPT = 64 << 20  # pairs of hidden values: 256 MiB, about 700,000 points of three layers


class Mlp(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        exp_cap: float | None,
        half: bool,
        limit: Tensor | None,
        threads: int,
        count: int,
        *tensors: Tensor,
    ) -> Tensor:
        tables, parameters = tensors[:count], tuple(t.contiguous() for t in tensors[count:])
        layers, outputs = len(parameters) // 2, len(parameters[-1])
        points, inputs = len(tables[0]), sum(t.shape[1] for t in tables)
        out = tables[0].new_empty(points, outputs)
        ctx.shape = [points, inputs, layers - 1, outputs, half]
        ctx.cap, ctx.threads, ctx.count = [] if exp_cap is None else [exp_cap], threads, count
        single, needed = out.dtype == torch.float32, any(ctx.needs_input_grad)
        numbers = native.mlp_kept(ctx.shape) if single and needed else 0
        ctx.kept = None
        if 0 < numbers <= MOST_KEPT:
            ctx.kept = torch.empty(numbers, dtype=torch.int32)
        kernels("mlp", out)(*_call(ctx, tables, parameters), addresses.of(out))
        ctx.save_for_backward(out, *tables, *parameters)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        out, *tensors = ctx.saved_tensors
        tables, parameters = tensors[: ctx.count], tensors[ctx.count :]
        v_out = grads[0].contiguous()
        needed = ctx.needs_input_grad[5 : 5 + ctx.count]
        v_tables = [t.new_empty(t.shape) for t in tables]
        v_parameters = [torch.empty_like(t) for t in parameters]
        kernels("mlp_bwd", out)(
            *_call(ctx, tables, parameters),
            *addresses.each((out, v_out)),
            [addresses.sized_table(t) for t in v_tables] if any(needed) else [],
            *addresses.halves(v_parameters),
        )
        wanted = [v if need else None for v, need in zip(v_tables, needed, strict=True)]
        return *[None] * 5, *wanted, *v_parameters


def _call(ctx: Any, tables: Sequence[Tensor], parameters: Sequence[Tensor]) -> tuple[Any, ...]:
    where = ([addresses.sized_table(t) for t in tables], *addresses.halves(parameters))
    return ctx.shape, *where, ctx.cap, addresses.of(ctx.kept), ctx.threads
