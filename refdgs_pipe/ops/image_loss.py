"""How far a rendered image is from a photo: L1 and SSIM and their gradient in one pass."""

from typing import Any

import _refdgs_native as native
import torch
from torch import Tensor

from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops import cuda, cuda_fused
from refdgs_pipe.ops.checks import check_alike


def image_loss(
    image: Tensor,
    target: Tensor,
    *,
    weight: Tensor | None = None,
    ssim_share: float = 0.2,
    threads: int | None = None,
) -> Tensor:
    """The mean over pixels and channels of (1 - s) |image - target| + s (1 - SSIM); a scalar.

    SSIM as in `ssim_map`. Only `image` gets a gradient; where image equals target, L1's is zero.
    Any strides are read as they are; the gradient is laid out in planes, as renders are.

    Args:
        image: (H, W, C) in 0..1.
        target: (H, W, C), constant.
        weight: (H, W) of each pixel's share, at least 0, constant; the loss is divided by its sum,
            and is 0 if that is 0. A pixel of weight 0 still lies in its neighbours' windows.
        ssim_share: s, 0 to 1.
        threads: default torch's; the result does not depend on it.

    Raises:
        ShapeError: sizes or types disagree, or target or weight asks for a gradient.
    """
    return image_loss_and_error(
        image, target, weight=weight, ssim_share=ssim_share, threads=threads
    )[0]


def image_loss_and_error(
    image: Tensor,
    target: Tensor,
    *,
    weight: Tensor | None = None,
    ssim_share: float = 0.2,
    threads: int | None = None,
) -> tuple[Tensor, Tensor]:
    """`image_loss` and, without gradient, the weighted mean of (image - target)^2.

    Raises:
        ShapeError: as `image_loss` has it.
    """
    _check(image, target, weight)
    if not 0 <= ssim_share <= 1:
        raise ShapeError(f"ssim_share is {ssim_share}: give 0 to 1")
    if cuda.on_gpu(image):
        on_gpu: tuple[Tensor, Tensor] = cuda_fused.ImageLoss.apply(  # type: ignore[no-untyped-call]
            image, target, weight, ssim_share
        )
        return on_gpu
    count = threads or torch.get_num_threads()
    pair: tuple[Tensor, Tensor] = _ImageLoss.apply(  # type: ignore[no-untyped-call]
        image, target, weight, ssim_share, count
    )
    return pair


def ssim_map(image: Tensor, target: Tensor, *, threads: int | None = None) -> Tensor:
    """(H, W, C) structural similarity of two (H, W, C) images in 0..1 (Wang et al. 2004).

    Local means are weighted by an 11 x 11 Gaussian of sigma 1.5 pixels; outside the image is zero.
    Without gradient.

    Raises:
        ShapeError: sizes or types disagree.
    """
    _check(image, target, None)
    planes = image.new_empty(image.shape[2], *image.shape[:2])
    _run(image, target, None, (0.0, 0.0), threads or torch.get_num_threads(), ssim=planes)
    return planes.permute(1, 2, 0)


def ssim(image: Tensor, target: Tensor, *, threads: int | None = None) -> float:
    """The mean of `ssim_map` over pixels and channels.

    Raises:
        ShapeError: sizes or types disagree, or the images are empty.
    """
    _check(image, target, None)
    if not image.numel():
        raise ShapeError(f"image is {tuple(image.shape)}: the mean of nothing has no value")
    _, similarity, _ = _run(image, target, None, (0.0, 0.0), threads or torch.get_num_threads())
    return similarity / image.numel()


def _run(
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
    if cuda.on_gpu(image):
        each = image.new_ones(1)
        found: list[float] = cuda_fused.compare(
            image, target, weight, each, scales, ssim=ssim
        ).tolist()
        return found[0], found[1], found[2]
    run = native.image_loss_float if image.dtype == torch.float32 else native.image_loss_double
    sums: tuple[float, float, float] = run(
        list(image.shape),
        image.data_ptr(),
        list(image.stride()),
        target.data_ptr(),
        list(target.stride()),
        0 if weight is None else weight.data_ptr(),
        *scales,
        threads,
        0 if gradient is None else gradient.data_ptr(),
        0 if ssim is None else ssim.data_ptr(),
    )
    return sums


class _ImageLoss(torch.autograd.Function):
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
        l1, similarity, squares = _run(image, target, weight, scales, threads, gradient=gradient)
        ctx.gradient = gradient
        constant = share if total > 0 else 0.0
        error = image.new_tensor(each * squares)
        ctx.mark_non_differentiable(error)
        return image.new_tensor(constant + scales[0] * l1 + scales[1] * similarity), error

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        planes = ctx.gradient if float(grads[0]) == 1 else ctx.gradient * grads[0]
        return planes.permute(1, 2, 0), None, None, None, None


def _check(image: Tensor, target: Tensor, weight: Tensor | None) -> None:
    if image.ndim != 3:
        raise ShapeError(f"image is {tuple(image.shape)}: give (H, W, C)")
    if target.shape != image.shape:
        raise ShapeError(
            f"target is {tuple(target.shape)} but image is {tuple(image.shape)}: give one size"
        )
    constants = [("target", target)]
    if weight is not None:
        constants.append(("weight", weight))
        if weight.shape != image.shape[:2]:
            raise ShapeError(
                f"weight is {tuple(weight.shape)} but image is {tuple(image.shape)}: give (H, W)"
            )
    check_alike(("image", image), *constants)
    for name, tensor in constants:
        if tensor.requires_grad:
            raise ShapeError(f"{name} asks for a gradient, but only image has one: detach it")
