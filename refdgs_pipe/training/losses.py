"""What a picture is asked to agree with."""

import torch
from torch import Tensor


def out_of_place(alpha: Tensor, beyond: Tensor) -> Tensor:
    """Mean cross-entropy of (H, W) alpha against nothing where it is known that nothing is.

    Args:
        beyond: (H, W) bool; other pixels count as right.
    """
    return -(torch.log1p(-alpha.clamp(0, 1 - 1e-4)) * beyond).mean()
