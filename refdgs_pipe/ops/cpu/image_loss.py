"""The image loss on the CPU."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses
from refdgs_pipe.ops.native import kernels


class ImageLoss(torch.autograd.Function):
    """The loss is a scalar, so forward computes the whole gradient and backward scales it."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, weight: Tensor | None, share: float, threads: int
    ) -> tuple[Tensor, Tensor]:
        weight = None if weight is None else weight.contiguous()
        height, width, channels = image.shape
        total = (height * width if weight is None else float(weight.sum())) * channels
        each = 1 / total if total > 0 else 0.0
        scales = ((1 - share) * each, -share * each)
        needed = ctx.needs_input_grad[0]
        gradient = image.new_empty(channels, height, width) if needed else None
        l1, similarity, squares = _compare(
            image, target, weight, scales, threads, gradient=gradient
        )
        ctx.gradient = gradient
        constant = share if total > 0 else 0.0
        error = image.new_tensor(each * squares)
        ctx.mark_non_differentiable(error)
        return image.new_tensor(constant + scales[0] * l1 + scales[1] * similarity), error

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        planes = ctx.gradient if float(grads[0]) == 1 else ctx.gradient * grads[0]
        return planes.permute(1, 2, 0), None, None, None, None


def ssim_map(image: Tensor, target: Tensor, threads: int) -> Tensor:
    """`ops.ssim_map`; inputs are checked there."""
    planes = image.new_empty(image.shape[2], *image.shape[:2])
    _compare(image, target, None, (0.0, 0.0), threads, ssim=planes)
    return planes.permute(1, 2, 0)


def ssim_sum(image: Tensor, target: Tensor, threads: int) -> float:
    """The sum of `ssim_map`."""
    return _compare(image, target, None, (0.0, 0.0), threads)[1]


def _compare(
    image: Tensor,
    target: Tensor,
    weight: Tensor | None,
    scales: tuple[float, float],
    threads: int,
    *,
    gradient: Tensor | None = None,
    ssim: Tensor | None = None,
) -> tuple[float, float, float]:
    """Weighted sums of |image - target|, SSIM and squares; fills `gradient`, `ssim`, (C, H, W)."""
    sums: tuple[float, float, float] = kernels("image_loss", image)(
        list(image.shape),
        *addresses.image(image),
        *addresses.image(target),
        addresses.of(weight),
        *scales,
        threads,
        *addresses.each((gradient, ssim)),
    )
    return sums
