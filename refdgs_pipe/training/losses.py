"""What a picture is asked to agree with."""

import torch
from torch import Tensor


def out_of_place(alpha: Tensor, beyond: Tensor) -> Tensor:
    """Mean cross-entropy of (H, W) alpha against nothing where it is known that nothing is.

    Args:
        beyond: (H, W) bool; other pixels count as right.
    """
    return -(torch.log1p(-alpha.clamp(0, 1 - 1e-4)) * beyond).mean()


def mirrored(radiance: Tensor, pixels: Tensor, count: int) -> Tensor:
    """Mean specular radiance of a picture, linear.

    Args:
        radiance: (P, 3) at `pixels` (P,); rows of no pixel (below 0) count for nothing.
        count: pixels of the picture.
    """
    return torch.where(pixels[:, None] >= 0, radiance, 0.0).sum() / (3 * count)
