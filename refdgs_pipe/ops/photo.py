"""What a training photo, kept as bytes, asks of a render."""

import torch
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError
from refdgs_pipe.ops.checks import check_alike
from refdgs_pipe.ops.cpu import photo as on_cpu
from refdgs_pipe.ops.definition import photo as definition
from refdgs_pipe.ops.gpu import photo as on_gpu
from refdgs_pipe.ops.registry import Operation

_COMPOSITED = Operation("composited", definition.composited, on_cpu.composited, on_gpu.composited)
_MASK_ENTROPY = Operation(
    "mask_entropy", definition.mask_entropy, on_cpu.MaskEntropy, on_gpu.MaskEntropy
)


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
    count = threads or torch.get_num_threads()
    target: Tensor = _COMPOSITED.kernel(rgb)(rgb, mask, backdrop, count)
    return target


def mask_entropy(
    alpha: Tensor,
    mask: Tensor,
    *,
    weight: float = 1.0,
    whole: bool = True,
    threads: int | None = None,
) -> Tensor:
    """`weight` times the mean binary cross-entropy of alpha against a soft mask; a scalar.

    Alpha counts as 1e-4 to 1 - 1e-4; beyond, it gets no gradient.

    Args:
        alpha: (H, W).
        mask: (H, W) uint8, constant.
        whole: false: on a GPU parts of it, for `total` and nothing else.
        threads: default torch's; the result does not depend on it.

    Raises:
        ShapeError: sizes or types disagree, or there is no pixel.
        DeviceError: the tensors are on several devices.
    """
    check_alike(("alpha", alpha))
    if alpha.ndim != 2 or not alpha.numel():
        raise ShapeError(f"alpha is {tuple(alpha.shape)}: give (H, W), at least one pixel")
    _check_mask(mask, alpha)
    count = threads or torch.get_num_threads()
    loss: Tensor = _MASK_ENTROPY.kernel(alpha)(alpha, mask.contiguous(), weight, whole, count)
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
