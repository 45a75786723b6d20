"""How far a rendered image is from a photo: L1 and SSIM and their gradient in one pass."""

import torch
from torch import Tensor

from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops.checks import check_alike
from refdgs_pipe.ops.cpu import image_loss as on_cpu
from refdgs_pipe.ops.definition import image_loss as definition
from refdgs_pipe.ops.gpu import image_loss as on_gpu
from refdgs_pipe.ops.registry import Operation

_IMAGE_LOSS = Operation(
    "image_loss_and_error", definition.image_loss_and_error, on_cpu.ImageLoss, on_gpu.ImageLoss
)
_SSIM_MAP = Operation("ssim_map", definition.ssim_map, on_cpu.ssim_map, on_gpu.ssim_map)
_SSIM_SUM = Operation("ssim", definition.ssim_sum, on_cpu.ssim_sum, on_gpu.ssim_sum)


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
    count = threads or torch.get_num_threads()
    pair: tuple[Tensor, Tensor] = _IMAGE_LOSS.kernel(image)(
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
    count = threads or torch.get_num_threads()
    similar: Tensor = _SSIM_MAP.kernel(image)(image, target, count)
    return similar


def ssim(image: Tensor, target: Tensor, *, threads: int | None = None) -> float:
    """The mean of `ssim_map` over pixels and channels.

    Raises:
        ShapeError: sizes or types disagree, or the images are empty.
    """
    _check(image, target, None)
    if not image.numel():
        raise ShapeError(f"image is {tuple(image.shape)}: the mean of nothing has no value")
    count = threads or torch.get_num_threads()
    total: float = _SSIM_SUM.kernel(image)(image, target, count)
    return total / image.numel()


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
