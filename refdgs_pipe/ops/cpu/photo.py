"""What a training photo asks of a render, on the CPU."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses
from refdgs_pipe.ops.native import kernels


def composited(rgb: Tensor, mask: Tensor | None, backdrop: Tensor, threads: int) -> Tensor:
    """`ops.composited`; inputs are checked there."""
    planes = backdrop.new_empty(rgb.shape)
    rgb, mask = rgb.contiguous(), None if mask is None else mask.contiguous()
    kernels("composited", planes)(
        [*rgb.shape[1:]],
        *addresses.each((rgb, mask)),
        backdrop.tolist(),
        threads,
        addresses.of(planes),
    )
    return planes.permute(1, 2, 0)


class MaskEntropy(torch.autograd.Function):
    """The loss is a scalar, so forward computes the whole gradient and backward scales it."""

    @staticmethod
    def forward(
        ctx: Any, alpha: Tensor, mask: Tensor, weight: float, whole: bool, threads: int
    ) -> Tensor:
        scale = weight / alpha.numel()
        ctx.gradient = alpha.new_empty(alpha.shape) if ctx.needs_input_grad[0] else None
        total: float = kernels("mask_entropy", alpha)(
            [*alpha.shape],
            [addresses.image(alpha)],
            addresses.of(mask),
            scale,
            threads,
            addresses.of(ctx.gradient),
        )
        return alpha.new_tensor(scale * total)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        scale = float(grads[0])
        return ctx.gradient if scale == 1 else ctx.gradient * scale, *[None] * 4
