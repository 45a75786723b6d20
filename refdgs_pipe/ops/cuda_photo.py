"""What a training photo asks of a render, on a GPU; nothing waits for it."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda

BLOCK = 256  # pixels whose part of the sum is one


def composited(rgb: Tensor, mask: Tensor | None, backdrop: Tensor) -> Tensor:
    """`ops.composited`; inputs are checked there."""
    planes = backdrop.new_empty(rgb.shape)
    rgb, backdrop = rgb.contiguous(), backdrop.contiguous()
    mask = None if mask is None else mask.contiguous()
    cuda.kernels("composited", backdrop)(
        [*rgb.shape[1:]],
        [rgb.data_ptr(), 0 if mask is None else mask.data_ptr()],
        backdrop.data_ptr(),
        planes.data_ptr(),
    )
    return planes.permute(1, 2, 0)


class MaskEntropy(torch.autograd.Function):
    """Forward computes the whole gradient of the scalar and backward scales it."""

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, mask: Tensor, weight: float) -> Tensor:
        ctx.gradient = alpha.new_empty(alpha.shape) if ctx.needs_input_grad[0] else None
        loss = alpha.new_empty(())
        parts = cuda.memory(-(-alpha.numel() // BLOCK) * alpha.itemsize, alpha)
        gradient = 0 if ctx.gradient is None else ctx.gradient.data_ptr()
        cuda.kernels("mask_entropy", alpha)(
            [*alpha.shape],
            [addresses.image(alpha)],
            mask.data_ptr(),
            weight / alpha.numel(),
            [gradient, parts.data_ptr(), loss.data_ptr()],
        )
        return loss

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.gradient * grads[0], None, None
