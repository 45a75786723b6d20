"""What a training photo, kept as bytes, asks of a render."""

from typing import Any

import _refdgs_native as native
import torch
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError
from refdgs_pipe.ops import addresses, cuda, cuda_photo
from refdgs_pipe.ops.checks import check_alike


def composited(
    rgb: Tensor, mask: Tensor | None, backdrop: Tensor, *, threads: int | None = None
) -> Tensor:
    """(H, W, 3) target in 0..1, in planes: rgb mask + (1 - mask) backdrop, without gradient.

    Args:
        rgb: (3, H, W) uint8 sRGB, straight.
        mask: (H, W) uint8, or None for a photo as it is.
        backdrop: (3,) sRGB in 0..1; its type is the result's.
        threads: default torch's; the result does not depend on it.

    Raises:
        ShapeError: sizes or types disagree.
        DeviceError: the tensors are on several devices.
    """
    check_alike(("backdrop", backdrop))
    if rgb.ndim != 3 or len(rgb) != 3 or rgb.dtype != torch.uint8 or tuple(backdrop.shape) != (3,):
        raise ShapeError(
            f"rgb is {tuple(rgb.shape)} of {rgb.dtype} and backdrop {tuple(backdrop.shape)}: "
            "give (3, H, W) uint8 and (3,)"
        )
    if mask is not None:
        _check_mask(mask, rgb[0])
    if backdrop.device != rgb.device:
        raise DeviceError(
            f"backdrop is on {backdrop.device}, rgb is on {rgb.device}: give all on one device"
        )
    if cuda.on_gpu(rgb):
        return cuda_photo.composited(rgb, mask, backdrop)
    planes = backdrop.new_empty(rgb.shape)
    rgb, mask = rgb.contiguous(), None if mask is None else mask.contiguous()
    run = native.composited_float if planes.dtype == torch.float32 else native.composited_double
    run(
        [*rgb.shape[1:]],
        rgb.data_ptr(),
        0 if mask is None else mask.data_ptr(),
        backdrop.tolist(),
        threads or torch.get_num_threads(),
        planes.data_ptr(),
    )
    return planes.permute(1, 2, 0)


def mask_entropy(
    alpha: Tensor, mask: Tensor, *, weight: float = 1.0, threads: int | None = None
) -> Tensor:
    """`weight` times the mean binary cross-entropy of alpha against a soft mask; a scalar.

    Alpha counts as 1e-4 to 1 - 1e-4; beyond, it gets no gradient.

    Args:
        alpha: (H, W).
        mask: (H, W) uint8, constant.
        threads: default torch's; the result does not depend on it.

    Raises:
        ShapeError: sizes or types disagree, or there is no pixel.
        DeviceError: the tensors are on several devices.
    """
    check_alike(("alpha", alpha))
    if alpha.ndim != 2 or not alpha.numel():
        raise ShapeError(f"alpha is {tuple(alpha.shape)}: give (H, W), at least one pixel")
    _check_mask(mask, alpha)
    if cuda.on_gpu(alpha):
        on_gpu: Tensor = cuda_photo.MaskEntropy.apply(  # type: ignore[no-untyped-call]
            alpha, mask.contiguous(), weight
        )
        return on_gpu
    count = threads or torch.get_num_threads()
    loss: Tensor = _MaskEntropy.apply(  # type: ignore[no-untyped-call]
        alpha, mask.contiguous(), weight, count
    )
    return loss


def _check_mask(mask: Tensor, image: Tensor) -> None:
    size = tuple(image.shape)
    if mask.device != image.device:
        raise DeviceError(
            f"mask is on {mask.device}, its image on {image.device}: give all on one device"
        )
    if tuple(mask.shape) != size or mask.dtype != torch.uint8:
        raise ShapeError(
            f"mask is {tuple(mask.shape)} of {mask.dtype}: give {size[0]} rows of {size[1]} uint8"
        )


class _MaskEntropy(torch.autograd.Function):
    """The loss is a scalar, so forward computes the whole gradient and backward scales it."""

    @staticmethod
    def forward(ctx: Any, alpha: Tensor, mask: Tensor, weight: float, threads: int) -> Tensor:
        scale = weight / alpha.numel()
        ctx.gradient = alpha.new_empty(alpha.shape) if ctx.needs_input_grad[0] else None
        single = alpha.dtype == torch.float32
        run = native.mask_entropy_float if single else native.mask_entropy_double
        total = run(
            [*alpha.shape],
            [addresses.image(alpha)],
            mask.data_ptr(),
            scale,
            threads,
            0 if ctx.gradient is None else ctx.gradient.data_ptr(),
        )
        return alpha.new_tensor(scale * total)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        scale = float(grads[0])
        return ctx.gradient if scale == 1 else ctx.gradient * scale, None, None, None
