"""Photos as targets in plain torch."""

import torch
from torch import Tensor


def composited(rgb: Tensor, mask: Tensor | None, backdrop: Tensor, threads: int = 1) -> Tensor:
    """`ops.composited`."""
    color = rgb.permute(1, 2, 0).to(backdrop.dtype) / 255
    if mask is None:
        return color
    m = (mask.to(backdrop.dtype) / 255)[..., None]
    return color * m + (1 - m) * backdrop


def mask_entropy(
    alpha: Tensor, mask: Tensor, weight: float, whole: bool, threads: int = 1
) -> Tensor:
    """`ops.mask_entropy`."""
    m, a = mask.to(alpha.dtype) / 255, alpha.clamp(1e-4, 1 - 1e-4)
    return -weight * (m * torch.log(a) + (1 - m) * torch.log(1 - a)).mean()
