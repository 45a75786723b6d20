"""The image loss in plain torch."""

import torch
from torch import Tensor

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def ssim_map(image: Tensor, target: Tensor, threads: int = 1) -> Tensor:
    """(H, W, C) structural similarity of two (H, W, C) images in 0..1 (Wang et al. 2004).

    Local means are weighted by an 11 x 11 Gaussian of sigma 1.5 pixels; outside the image is zero.
    """
    channels = image.shape[-1]
    offset = torch.arange(WINDOW, dtype=image.dtype) - WINDOW // 2
    taps = torch.exp(-(offset**2) / (2 * SIGMA**2))
    taps = taps / taps.sum()
    kernel = torch.outer(taps, taps).expand(channels, 1, WINDOW, WINDOW)

    def blur(values: Tensor) -> Tensor:
        planes = values.permute(2, 0, 1)[None]
        mean = torch.nn.functional.conv2d(planes, kernel, padding=WINDOW // 2, groups=channels)
        return mean[0].permute(1, 2, 0)

    mx, my = blur(image), blur(target)
    xx, yy = blur(image * image) - mx * mx, blur(target * target) - my * my
    xy = blur(image * target) - mx * my
    similar = (2 * mx * my + C1) * (2 * xy + C2)
    return similar / ((mx * mx + my * my + C1) * (xx + yy + C2))


def ssim_sum(image: Tensor, target: Tensor, threads: int = 1) -> float:
    """The sum of `ssim_map`."""
    return float(ssim_map(image, target).sum())


def image_loss_and_error(
    image: Tensor, target: Tensor, weight: Tensor | None, share: float, threads: int = 1
) -> tuple[Tensor, Tensor]:
    """`ops.image_loss_and_error`."""
    loss = (1 - share) * (image - target).abs() + share * (1 - ssim_map(image, target))
    error = (image - target).detach() ** 2
    if weight is None:
        return loss.mean(), error.mean()
    each = (weight / (weight.sum() * image.shape[-1]).clamp(min=1e-12))[..., None]
    return (each * loss).sum(), (each * error).sum()
