"""Deferred shading around the shader's network: gather, composite, and normals against depth."""

import math

import torch
from torch import Tensor

from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops.checks import check_alike
from refdgs_pipe.ops.cpu import shade as on_cpu
from refdgs_pipe.ops.definition import shade as definition
from refdgs_pipe.ops.gpu import shade as on_gpu
from refdgs_pipe.ops.plan import Plan
from refdgs_pipe.ops.registry import Operation
from refdgs_pipe.ops.scene import Pinhole

_COVERED_PIXELS = Operation(
    "covered_pixels", definition.covered_pixels, definition.covered_pixels, on_gpu.covered_pixels
)
_SHADING_INPUTS = Operation(
    "shading_inputs", definition.shading_inputs, on_cpu.ShadingInputs, on_gpu.ShadingInputs
)
_COMPOSITE = Operation("composite", definition.composite, on_cpu.Composite, on_gpu.Composite)
_NORMAL_AGREEMENT = Operation(
    "normal_agreement",
    definition.normal_agreement,
    on_cpu.NormalAgreement,
    on_gpu.NormalAgreement,
)
_NORMAL_SMOOTHNESS = Operation(
    "normal_smoothness",
    definition.normal_smoothness,
    on_cpu.NormalSmoothness,
    on_gpu.NormalSmoothness,
)


def covered_pixels(alpha: Tensor, least: float, plan: Plan | None = None) -> Tensor:
    """(P,) int64, row * W + column, ascending: the pixels where alpha (H, W) is above `least`.

    Without a plan a GPU is waited for. With one, P is the planned room and the rest is -1, which
    stands for no pixel in everything that takes `pixels`: what is made there counts for nothing.
    """
    pixels: Tensor = _COVERED_PIXELS.kernel(alpha)(alpha.detach(), least, plan)
    return pixels


def shading_inputs(
    features: Tensor,
    alpha: Tensor,
    normal: Tensor,
    near: Tensor | None,
    pixels: Tensor,
    camera: Pinhole,
    *,
    threads: int | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
    """What the shader is given at covered pixels.

    Args:
        features: (H, W, C >= 4), sums of w f; the first four are diffuse (linear) and roughness.
        alpha: (H, W) sums of w, above 0 at `pixels`.
        normal: (H, W, 3) sums of w n, world.
        near: (H, W, 4) local reflection features, or None.
        pixels: (P,) of `covered_pixels`.
        camera: constant: its pose gets no gradient.
        threads: default torch's; the result does not depend on it.

    Returns:
        features / alpha as diffuse (P, 3) and roughness (P,); the mirrored view ray (P, 3), unit,
        world; the cosine (P,) between normal and view, 0 to 1; near at the pixels (P, 4) as it is,
        or None. Strides are of planes, but for near.

    Raises:
        ShapeError: sizes or types disagree.
    """
    size = (camera.height, camera.width)
    _check_images(size, features=features, alpha=alpha, normal=normal, near=near)
    if features.shape[2] < 4 or (near is not None and near.shape[2] != 4):
        raise ShapeError("features need at least 4 channels, and near exactly 4")
    count = threads or torch.get_num_threads()
    *parts, gathered = _SHADING_INPUTS.kernel(alpha)(
        features, alpha, normal, near, pixels.contiguous(), camera, count
    )
    diffuse, roughness, reflected, cosine = parts
    return diffuse, roughness, reflected, cosine, None if near is None else gathered


def composite(
    diffuse: Tensor,
    radiance: Tensor,
    pixels: Tensor,
    object_alpha: Tensor,
    alpha: Tensor,
    backdrop: Tensor,
    behind: Tensor | None = None,
    *,
    threads: int | None = None,
) -> Tensor:
    """object_alpha srgb(diffuse + radiance) + (1 - alpha) backdrop + behind: (H, W, 3) sRGB.

    Linear values are clipped to [1e-6, 1]; above 1 a gradient passes only if it darkens, so that a
    highlight which its photo clips is not pushed up without end.

    Args:
        diffuse, radiance: (P, 3) linear, any strides.
        pixels: (P,) of `covered_pixels`; elsewhere the object is black.
        object_alpha, alpha: (H, W).
        backdrop: (3,) sRGB, constant.
        behind: (H, W, 3) sRGB, premultiplied, or None.
        threads: default torch's; the result does not depend on it.

    Raises:
        ShapeError: sizes or types disagree.
    """
    _check_images(tuple(alpha.shape), alpha=alpha, object_alpha=object_alpha, behind=behind)
    check_alike(("diffuse", diffuse), ("radiance", radiance), ("alpha", alpha))
    expected = (len(pixels), 3)
    if tuple(diffuse.shape) != expected or tuple(radiance.shape) != expected:
        raise ShapeError(
            f"diffuse is {tuple(diffuse.shape)} and radiance {tuple(radiance.shape)}: "
            f"give {expected}, one row for each pixel"
        )
    count = threads or torch.get_num_threads()
    image: Tensor = _COMPOSITE.kernel(alpha)(
        diffuse, radiance, pixels.contiguous(), object_alpha, alpha, backdrop, behind, count
    )
    return image


def normal_agreement(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    camera: Pinhole,
    *,
    edge: float = math.inf,
    weight: float = 1.0,
    whole: bool = True,
    threads: int | None = None,
) -> Tensor:
    """`weight` times the mean of alpha (1 - n . n_depth) over pixels with four neighbours.

    Pixels at an edge of the depth count as 0: there a surface ends in front of another, and
    agreement would close the gap between the two.

    n_depth: of the depth map, by central differences (2D Gaussian Splatting, section 5). Gradients
    reach normal, depth and alpha through the depth's mean; alpha as a weight is constant.

    Args:
        normal: (H, W, 3) sums of w n, world; depth: (H, W) sums of w z; alpha: (H, W) sums of w.
        camera: constant.
        edge: second differences of the depth above this are an edge, in pixel footprints z / fx.
        whole: false: on a GPU parts of it, for `total` and nothing else.
        threads: default torch's; the result does not depend on it.

    Raises:
        ShapeError: sizes or types disagree, or the image has no inner pixel.
    """
    size = (camera.height, camera.width)
    _check_images(size, normal=normal, depth=depth, alpha=alpha)
    if min(size) < 3:
        raise ShapeError(f"image of {camera.width}x{camera.height}: no pixel has four neighbours")
    count = threads or torch.get_num_threads()
    loss: Tensor = _NORMAL_AGREEMENT.kernel(alpha)(
        normal, depth, alpha, camera, edge, weight, whole, count
    )
    return loss


def normal_smoothness(
    normal: Tensor,
    features: Tensor,
    depth: Tensor,
    alpha: Tensor,
    object_alpha: Tensor,
    *,
    shaded: float,
    weight: float = 1.0,
    whole: bool = True,
    threads: int | None = None,
) -> Tensor:
    """`weight` times the mean |n_p - n_q| of neighbours, damped at edges but not at reflections.

    A step between pixels counts exp(-10 |difference of diffuse| - 100 |difference of depth| /
    depth), and nothing where one of them has an alpha below 0.9. Means of steps to the right and of
    steps down are added. The gradient reaches the normal alone.

    Args:
        normal: (H, W, 3) sums of w n, world.
        features: (H, W, C) sums of w times what surfels carry, linear diffuse colour first.
        depth: (H, W) sums of w z; alpha: (H, W) sums of w.
        object_alpha: (H, W), what `features` are divided by; at most `shaded`, diffuse is 0.
        whole: false: on a GPU parts of it, for `total` and nothing else.
        threads: default torch's; the result does not depend on it.

    Raises:
        ShapeError: sizes or types disagree, or the image is a single row or column.
    """
    size = tuple(alpha.shape)
    images = {"normal": normal, "features": features, "depth": depth, "alpha": alpha}
    _check_images(size, **images, object_alpha=object_alpha)
    if min(size) < 2:
        raise ShapeError(f"image of {size[1]}x{size[0]}: no pixel has neighbours on two sides")
    count = threads or torch.get_num_threads()
    loss: Tensor = _NORMAL_SMOOTHNESS.kernel(alpha)(
        *images.values(), object_alpha, shaded, weight, whole, count
    )
    return loss


def _check_images(size: tuple[int, ...], **images: Tensor | None) -> None:
    given = [(name, image) for name, image in images.items() if image is not None]
    for name, image in given:
        if tuple(image.shape[:2]) != size:
            raise ShapeError(f"{name} is {tuple(image.shape)}: give {size[0]} rows of {size[1]}")
    check_alike(*given)
