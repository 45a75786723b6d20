"""The shader's network in plain torch: the definition that the compiled one is proved against."""

from collections.abc import Sequence

import torch
from torch import Tensor

from refdgs_pipe.ops.shade import clip


def mlp(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], *, exp_cap: float | None = None
) -> Tensor:
    """Same meaning as `ops.mlp`."""
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = torch.relu(torch.nn.functional.linear(x, weight, bias))
    y = torch.nn.functional.linear(x, weights[-1], biases[-1])
    return y if exp_cap is None else clip(y, exp_cap).exp()
