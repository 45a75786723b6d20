"""The image loss on a GPU; nothing waits for it."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda
from refdgs_pipe.ops.gpu.elementwise import scaled

TILE, SUMS = 16, 3  # pixels along the edge of a block's tile; its sums


class ImageLoss(torch.autograd.Function):
    """The loss and the mean squared error; forward computes the whole gradient of the first."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, weight: Tensor | None, share: float, threads: int
    ) -> tuple[Tensor, Tensor]:
        weight = None if weight is None else weight.contiguous()
        height, width, channels = image.shape
        each = None
        if weight is not None:
            total = weight.sum().reshape(1) * channels
            each = torch.where(total > 0, 1 / total, 0.0)
        needed = ctx.needs_input_grad[0]
        ctx.gradient = image.new_empty(channels, height, width) if needed else None
        shares, loss = (1 - share, -share), (image.new_empty(()), image.new_empty(()))
        _compare(image, target, weight, each, shares, gradient=ctx.gradient, loss=loss)
        ctx.mark_non_differentiable(loss[1])
        ctx.set_materialize_grads(False)
        return loss

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        if grads[0] is None:
            return (None,) * 5
        return scaled(ctx.gradient, grads[0]).permute(1, 2, 0), None, None, None, None


def ssim_map(image: Tensor, target: Tensor, threads: int) -> Tensor:
    """`ops.ssim_map`; inputs are checked there."""
    planes = image.new_empty(image.shape[2], *image.shape[:2])
    _compare(image, target, None, None, (0.0, 0.0), ssim=planes)
    return planes.permute(1, 2, 0)


def ssim_sum(image: Tensor, target: Tensor, threads: int) -> float:
    """The sum of `ssim_map`, waited for."""
    return float(_compare(image, target, None, None, (0.0, 0.0))[1])


def _compare(
    image: Tensor,
    target: Tensor,
    weight: Tensor | None,
    each: Tensor | None,
    shares: tuple[float, float],
    *,
    gradient: Tensor | None = None,
    ssim: Tensor | None = None,
    loss: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """(3,) weighted sums of |image - target|, of SSIM and of (image - target)^2.

    Fills `gradient` and `ssim`, (C, H, W), and `loss`, its two scalars of the loss and the mean
    squared error, where they are given.

    Args:
        each: (1,) what one unit of weight counts for in the loss; None: a mean over all.
        shares: of the first two sums in the loss.
    """
    height, width, channels = image.shape
    blocks = channels * -(-height // TILE) * -(-width // TILE)
    sums = image.new_empty(SUMS)
    slopes = cuda.memory(0 if gradient is None else 3 * image.numel() * image.itemsize, image)
    parts = cuda.memory(SUMS * blocks * image.itemsize, image)
    scratch = None if gradient is None else slopes
    cuda.kernels("image_loss", image)(
        list(image.shape),
        [addresses.image(image), addresses.image(target)],
        addresses.each((weight, each)),
        [*shares, 1 / image.numel() if image.numel() else 0.0],
        addresses.each((scratch, gradient, ssim, parts, sums, *(loss or (None, None)))),
    )
    return sums
