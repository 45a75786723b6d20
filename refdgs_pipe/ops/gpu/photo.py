"""What a training photo asks of a render, on a GPU; nothing waits for it."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda
from refdgs_pipe.ops.gpu.elementwise import scaled

BLOCK = 256  # pixels whose part of the sum is one


def composited(rgb: Tensor, mask: Tensor | None, backdrop: Tensor, threads: int) -> Tensor:
    """`ops.composited`; inputs are checked there."""
    planes = backdrop.new_empty(rgb.shape)
    rgb, backdrop = rgb.contiguous(), backdrop.contiguous()
    mask = None if mask is None else mask.contiguous()
    cuda.kernels("composited", backdrop)(
        [*rgb.shape[1:]],
        addresses.each((rgb, mask)),
        *addresses.each((backdrop, planes)),
    )
    return planes.permute(1, 2, 0)


class MaskEntropy(torch.autograd.Function):
    """Forward computes the whole gradient of the scalar and backward scales it."""

    @staticmethod
    def forward(
        ctx: Any, alpha: Tensor, mask: Tensor, weight: float, whole: bool, threads: int
    ) -> Tensor:
        ctx.gradient = alpha.new_empty(alpha.shape) if ctx.needs_input_grad[0] else None
        loss = alpha.new_empty(()) if whole else None
        parts = alpha.new_empty(-(-alpha.numel() // BLOCK))
        cuda.kernels("mask_entropy", alpha)(
            [*alpha.shape],
            [addresses.image(alpha)],
            addresses.of(mask),
            weight / alpha.numel(),
            addresses.each((ctx.gradient, parts, loss)),
        )
        return parts if loss is None else loss

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return scaled(ctx.gradient, grads[0]), *[None] * 4
