"""The shader's network in plain torch."""

import torch
from torch import Tensor

from refdgs_pipe.ops.clip import clip


def mlp(
    exp_cap: float | None,
    half: bool,
    limit: Tensor | None,
    threads: int,
    count: int,
    *tensors: Tensor,
) -> Tensor:
    """`ops.mlp`: `tensors` are `count` tables of inputs, then weights, then biases."""
    x, parameters = torch.cat(tensors[:count], 1), tensors[count:]
    half_way = len(parameters) // 2
    layers = list(zip(parameters[:half_way], parameters[half_way:], strict=True))
    for weight, bias in layers[:-1]:
        x = torch.relu(torch.nn.functional.linear(x, weight, bias))
    y = torch.nn.functional.linear(x, *layers[-1])
    return y if exp_cap is None else clip(y, exp_cap).exp()
