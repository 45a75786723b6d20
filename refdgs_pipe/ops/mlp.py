"""The shader's network on many pixels at once."""

from collections.abc import Sequence
from typing import Any

import _refdgs_native as native
import torch
from torch import Tensor

from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops import cuda, cuda_fused
from refdgs_pipe.ops.checks import check_alike

HIDDEN = 64
MAX_INPUTS = 32
MAX_OUTPUTS = 4
MAX_HIDDEN_LAYERS = 8
MOST_KEPT = 64 << 20  # hidden values, in 4-byte pairs: 256 MiB, about 700,000 points of three layers


def mlp(
    x: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    *,
    exp_cap: float | None = None,
    half: bool = False,
    threads: int | None = None,
) -> Tensor:
    """Hidden layers of 64 with ReLU, then a linear layer, then exp(min(y, exp_cap)) if asked for.

    With float products nothing is kept for the backward pass but x and the result: hidden values
    are computed again. As bfloat16 numbers they are kept, 128 bytes a point and layer, if that is at
    most 256 MiB. Above the cap a gradient passes only if it lowers the result, as `clip` has it.

    Args:
        x: (P, inputs), at most 32 inputs, any strides.
        weights: as `torch.nn.Linear` has them: (64, inputs), (64, 64)..., (outputs, 64); at least
            one hidden layer and at most 8, and at most 4 outputs.
        biases: (64,)..., (outputs,).
        half: multiply bfloat16 numbers and sum them as floats, where the CPU can (AVX512-BF16):
            twice as fast, good to about 3 digits. The first and the last layer's outputs are
            multiplied as they are. No difference for doubles, and none on a GPU.
        threads: default torch's; the result does not depend on it.

    Returns:
        (P, outputs)

    Raises:
        ShapeError: sizes or types that must agree do not, or exceed these limits.
    """
    _check(x, weights, biases)
    if cuda.on_gpu(x):
        on_gpu: Tensor = cuda_fused.Mlp.apply(  # type: ignore[no-untyped-call]
            x, exp_cap, *weights, *biases
        )
        return on_gpu
    count = threads or torch.get_num_threads()
    result: Tensor = _Mlp.apply(  # type: ignore[no-untyped-call]
        x, exp_cap, half, count, *weights, *biases
    )
    return result


class _Mlp(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, exp_cap: float | None, half: bool, threads: int, *parameters: Tensor
    ) -> Tensor:
        parameters = tuple(t.contiguous() for t in parameters)
        layers = len(parameters) // 2
        outputs = len(parameters[-1])
        out = x.new_empty(len(x), outputs)
        ctx.shape = [*x.shape, layers - 1, outputs, half]
        ctx.cap, ctx.threads = [] if exp_cap is None else [exp_cap], threads
        single, needed = x.dtype == torch.float32, any(ctx.needs_input_grad)
        numbers = native.mlp_kept(ctx.shape) if single and needed else 0
        ctx.kept = None
        if 0 < numbers <= MOST_KEPT:
            ctx.kept = torch.empty(numbers, dtype=torch.int32)
        run = native.mlp_float if x.dtype == torch.float32 else native.mlp_double
        run(*_call(ctx, x, parameters), out.data_ptr())
        ctx.save_for_backward(x, out, *parameters)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, out, *parameters = ctx.saved_tensors
        v_out = grads[0].contiguous()
        v_x = x.new_empty(x.shape) if ctx.needs_input_grad[0] else None
        v_parameters = [torch.empty_like(t) for t in parameters]
        run = native.mlp_bwd_float if x.dtype == torch.float32 else native.mlp_bwd_double
        run(
            *_call(ctx, x, parameters),
            out.data_ptr(),
            v_out.data_ptr(),
            0 if v_x is None else v_x.data_ptr(),
            *_addresses(v_parameters),
        )
        return v_x, None, None, None, *v_parameters


def _call(ctx: Any, x: Tensor, parameters: Sequence[Tensor]) -> tuple[Any, ...]:
    where = _addresses(parameters)
    kept = 0 if ctx.kept is None else ctx.kept.data_ptr()
    return ctx.shape, x.data_ptr(), list(x.stride()), *where, ctx.cap, kept, ctx.threads


def _addresses(parameters: Sequence[Tensor]) -> tuple[list[int], list[int]]:
    addresses = [t.data_ptr() for t in parameters]
    return addresses[: len(addresses) // 2], addresses[len(addresses) // 2 :]


def _check(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
    if x.ndim != 2 or not 1 <= x.shape[1] <= MAX_INPUTS:
        raise ShapeError(f"x is {tuple(x.shape)}: give (P, inputs) with 1 to {MAX_INPUTS} inputs")
    layers = len(weights)
    if len(biases) != layers or not 2 <= layers <= MAX_HIDDEN_LAYERS + 1:
        raise ShapeError(
            f"{layers} weights and {len(biases)} biases: give one of each per layer, "
            f"1 to {MAX_HIDDEN_LAYERS} hidden layers and the last"
        )
    named = []
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        inputs = x.shape[1] if index == 0 else HIDDEN
        last = index == layers - 1
        outputs = weight.shape[0] if last and weight.ndim == 2 else HIDDEN
        if tuple(weight.shape) != (outputs, inputs) or not 1 <= outputs <= HIDDEN:
            wanted = f"(outputs, {inputs})" if last else f"({HIDDEN}, {inputs})"
            raise ShapeError(f"weights[{index}] is {tuple(weight.shape)}: give {wanted}")
        if last and outputs > MAX_OUTPUTS:
            raise ShapeError(f"weights[{index}] has {outputs} outputs; at most {MAX_OUTPUTS}")
        if tuple(bias.shape) != (outputs,):
            raise ShapeError(f"biases[{index}] is {tuple(bias.shape)}: give ({outputs},)")
        named += [(f"weights[{index}]", weight), (f"biases[{index}]", bias)]
    check_alike(("x", x), *named)
