"""Light and its limits in plain torch, the same on every backend."""

from typing import Any

import torch
from torch import Tensor


def clip(x: Tensor, limit: float) -> Tensor:
    """min(x, limit) whose gradient above the limit only pulls down.

    So a highlight that is too bright for its photo comes back, and one that the photo clips is not
    pushed up without end.
    """
    out: Tensor = _ClipThatPullsDown.apply(x, limit)  # type: ignore[no-untyped-call]
    return out


def srgb_curve(linear: Tensor) -> Tensor:
    """sRGB of linear light above 0 (IEC 61966-2-1), in torch; nothing is clipped."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


class _ClipThatPullsDown(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, limit: float) -> Tensor:
        ctx.save_for_backward(x > limit)
        return x.clamp(max=limit)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (over,) = ctx.saved_tensors
        return torch.where(over & (grads[0] < 0), 0.0, grads[0]), None
