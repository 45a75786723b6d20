"""What lies between the other operations, in plain torch, which the CPU computes too."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

CURVES = ("sigmoid", "tanh", "diffuse")  # as the native functions number them
DARK = 3e-4  # sum of three linear colours below which no share is told

Observed = tuple[Tensor, Tensor, Tensor, Tensor]


def diffuse_of(raw: Tensor) -> Tensor:
    """Linear diffuse colour, exp(min(a, 5)) / 5."""
    return torch.exp(raw.clamp(max=5.0)) / 5.0


def total(*terms: Tensor) -> Tensor:
    """`ops.total`."""
    whole = terms[0]
    for term in terms[1:]:
        whole = whole + term
    return whole


def image_mean(image: Tensor, weight: float, divisor: float, whole: bool) -> Tensor:
    """`ops.image_mean`."""
    return weight * (image.mean() / divisor)


def mirrored(radiance: Tensor, pixels: Tensor, count: int, weight: float, whole: bool) -> Tensor:
    """`ops.mirrored`."""
    return weight * (torch.where(pixels[:, None] >= 0, radiance, 0.0).sum() / (3 * count))


def activated(
    curves: tuple[str, ...], log_scales: Tensor, raw_opacities: Tensor, *tables: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """`ops.activated`."""
    how: dict[str, Callable[[Tensor], Tensor]] = {
        "sigmoid": torch.sigmoid,
        "tanh": torch.tanh,
        "diffuse": diffuse_of,
    }
    carried = [
        how[curve](table).reshape(len(log_scales), math.prod(table.shape[1:]))
        for curve, table in zip(curves, tables, strict=True)
    ]
    side_by_side = log_scales.new_empty(len(log_scales), 0)
    if carried:
        side_by_side = carried[0] if len(carried) == 1 else torch.cat(carried, -1)
    return torch.exp(log_scales), torch.sigmoid(raw_opacities), side_by_side


def observe(sets: list[Observed], scale: float, misfit: Tensor | None) -> None:
    """`ops.observe`."""
    fits = True if misfit is None else misfit == 0
    for gradient_sum, seen, gradients, radii in sets:
        sees = (radii > 0) & fits
        gradient_sum += torch.where(sees, gradients[:, 0] * scale, 0.0)
        seen += sees


def damped(grad: Tensor, mirrored: Tensor, diffuse: Tensor, share: float) -> Tensor:
    """`ops.damped`."""
    light = mirrored.sum(-1, keepdim=True)
    found = light / (light + diffuse.sum(-1, keepdim=True)).clamp(min=DARK)
    return grad * found.div(share).clamp(max=1.0)
