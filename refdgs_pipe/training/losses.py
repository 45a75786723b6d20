"""What a picture is asked to agree with."""

import torch
from torch import Tensor


def normal_smoothness(normal: Tensor, diffuse: Tensor, depth: Tensor, alpha: Tensor) -> Tensor:
    """Mean |gradient of n|, damped at diffuse and depth edges but not at reflection edges."""

    def along(axis: int) -> Tensor:
        def step(image: Tensor) -> Tensor:
            n = image.shape[axis]
            return image.narrow(axis, 1, n - 1) - image.narrow(axis, 0, n - 1)

        solid = alpha.detach() > 0.9
        n = solid.shape[axis]
        both = solid.narrow(axis, 1, n - 1) & solid.narrow(axis, 0, n - 1)
        relative = step(depth.detach()).abs() / depth.detach().narrow(axis, 1, n - 1).clamp(
            min=1e-6
        )
        edge = 10 * step(diffuse.detach()).abs().sum(-1) + 100 * relative
        return (step(normal).abs().sum(-1) * torch.exp(-edge) * both).mean()

    return along(0) + along(1)


def out_of_place(alpha: Tensor, beyond: Tensor) -> Tensor:
    """Mean cross-entropy of (H, W) alpha against nothing where it is known that nothing is.

    Args:
        beyond: (H, W) bool; other pixels count as right.
    """
    return -(torch.log1p(-alpha.clamp(0, 1 - 1e-4)) * beyond).mean()
