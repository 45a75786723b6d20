"""The image loss in plain torch: the definition that the compiled one is proved against."""

import torch
from torch import Tensor

WINDOW = 11
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
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


def image_loss(
    image: Tensor, target: Tensor, *, weight: Tensor | None = None, ssim_share: float = 0.2
) -> Tensor:
    """Same meaning as `ops.image_loss`."""
    per_pixel = (1 - ssim_share) * (image - target).abs() + ssim_share * (
        1 - ssim_map(image, target)
    )
    if weight is None:
        return per_pixel.mean()
    total = weight.sum() * image.shape[-1]
    return (per_pixel * weight[..., None]).sum() / total.clamp(min=1e-12)
