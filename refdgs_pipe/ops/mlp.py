"""The shader's network on many pixels at once."""

from collections.abc import Sequence

import torch
from torch import Tensor

from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops.checks import check_alike
from refdgs_pipe.ops.cpu import mlp as on_cpu
from refdgs_pipe.ops.definition import mlp as definition
from refdgs_pipe.ops.gpu import mlp as on_gpu
from refdgs_pipe.ops.registry import Operation

HIDDEN = 64
MAX_INPUTS = 32
MAX_TABLES = 4
MAX_OUTPUTS = 4
MAX_HIDDEN_LAYERS = 8

_MLP = Operation("mlp", definition.mlp, on_cpu.Mlp, on_gpu.mlp)


def mlp(
    x: Tensor | Sequence[Tensor],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    *,
    exp_cap: float | None = None,
    half: bool = False,
    threads: int | None = None,
    limit: Tensor | None = None,
) -> Tensor:
    """Hidden layers of 64 with ReLU, then a linear layer, then exp(min(y, exp_cap)) if asked for.

    With float products nothing is kept for the backward pass but x and the result: hidden values
    are computed again. As bfloat16 numbers they are kept, 128 bytes a point and layer, if that is
    at most 256 MiB. Above the cap a gradient passes only if it lowers the result, as `clip` has it.

    Args:
        x: (P, inputs), at most 32 inputs, any strides; or several such or (P,), side by side.
        weights: as `torch.nn.Linear` has them: (64, inputs), (64, 64)..., (outputs, 64); at least
            one hidden layer and at most 8, and at most 4 outputs.
        biases: (64,)..., (outputs,).
        half: multiply bfloat16 numbers and sum them as floats, good to about 3 digits: where the
            CPU can (AVX512-BF16), twice as fast; on a GPU for three hidden layers and at most 15
            inputs. The first and the last layer's outputs are not rounded. No difference for
            doubles.
        threads: default torch's; the result does not depend on it.
        limit: (1,) int64 on a GPU: no more than the first that many rows are looked at there, and
            what is made of the others has no meaning.

    Returns:
        (P, outputs)

    Raises:
        ShapeError: sizes or types that must agree do not, or exceed these limits.
    """
    tables = [x] if isinstance(x, Tensor) else [t if t.ndim > 1 else t[:, None] for t in x]
    _check(tables, weights, biases)
    count = threads or torch.get_num_threads()
    result: Tensor = _MLP.kernel(tables[0])(
        exp_cap, half, limit, count, len(tables), *tables, *weights, *biases
    )
    return result


def _check(tables: Sequence[Tensor], weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
    shapes = " and ".join(str(tuple(t.shape)) for t in tables)
    fits = 1 <= len(tables) <= MAX_TABLES and all(t.ndim == 2 for t in tables)
    total = sum(t.shape[1] for t in tables) if fits else 0
    if not 1 <= total <= MAX_INPUTS or len({len(t) for t in tables}) != 1:
        raise ShapeError(
            f"x is {shapes or 'empty'}: give (P, inputs) with 1 to {MAX_INPUTS} inputs, "
            f"in at most {MAX_TABLES} tensors"
        )
    layers = len(weights)
    if len(biases) != layers or not 2 <= layers <= MAX_HIDDEN_LAYERS + 1:
        raise ShapeError(
            f"{layers} weights and {len(biases)} biases: give one of each per layer, "
            f"1 to {MAX_HIDDEN_LAYERS} hidden layers and the last"
        )
    named = []
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        inputs = total if index == 0 else HIDDEN
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
    check_alike(*[("x", t) for t in tables], *named)
