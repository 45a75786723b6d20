"""Deferred shading around the shader's network: gather, composite, and normals against depth."""

import math
from typing import Any

import _refdgs_native as native
import torch
from torch import Tensor

from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops import addresses, cuda, cuda_shade
from refdgs_pipe.ops.checks import check_alike
from refdgs_pipe.ops.plan import Plan
from refdgs_pipe.ops.rasterize import Pinhole


def covered_pixels(alpha: Tensor, least: float, plan: Plan | None = None) -> Tensor:
    """(P,) int64, row * W + column, ascending: the pixels where alpha (H, W) is above `least`.

    Without a plan a GPU is waited for. With one, P is the planned room and the rest is -1, which
    stands for no pixel in everything that takes `pixels`: what is made there counts for nothing.
    """
    if plan is not None and cuda.on_gpu(alpha):
        return cuda_shade.covered_pixels(alpha.detach(), least, plan)
    return torch.nonzero(alpha.detach().reshape(-1) > least).flatten()


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
    if cuda.on_gpu(alpha):
        on_gpu: list[Tensor] = cuda_shade.ShadingInputs.apply(  # type: ignore[no-untyped-call]
            features, alpha, normal, near, pixels.contiguous(), camera
        )
        diffuse, roughness, reflected, cosine, gathered = on_gpu
        return diffuse, roughness, reflected, cosine, None if near is None else gathered
    count = threads or torch.get_num_threads()
    *parts, gathered = _ShadingInputs.apply(  # type: ignore[no-untyped-call]
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
    if cuda.on_gpu(alpha):
        on_gpu: Tensor = cuda_shade.Composite.apply(  # type: ignore[no-untyped-call]
            diffuse, radiance, pixels.contiguous(), object_alpha, alpha, backdrop, behind
        )
        return on_gpu
    count = threads or torch.get_num_threads()
    image: Tensor = _Composite.apply(  # type: ignore[no-untyped-call]
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
        threads: default torch's; the result does not depend on it.

    Raises:
        ShapeError: sizes or types disagree, or the image has no inner pixel.
    """
    size = (camera.height, camera.width)
    _check_images(size, normal=normal, depth=depth, alpha=alpha)
    if min(size) < 3:
        raise ShapeError(f"image of {camera.width}x{camera.height}: no pixel has four neighbours")
    if cuda.on_gpu(alpha):
        on_gpu: Tensor = cuda_shade.NormalAgreement.apply(  # type: ignore[no-untyped-call]
            normal, depth, alpha, camera, edge
        )
        return weight * on_gpu
    count = threads or torch.get_num_threads()
    loss: Tensor = _NormalAgreement.apply(  # type: ignore[no-untyped-call]
        normal, depth, alpha, camera, edge, weight, count
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
        threads: default torch's; the result does not depend on it.

    Raises:
        ShapeError: sizes or types disagree, or the image is a single row or column.
    """
    size = tuple(alpha.shape)
    images = {"normal": normal, "features": features, "depth": depth, "alpha": alpha}
    _check_images(size, **images, object_alpha=object_alpha)
    if min(size) < 2:
        raise ShapeError(f"image of {size[1]}x{size[0]}: no pixel has neighbours on two sides")
    given = (*images.values(), object_alpha)
    if cuda.on_gpu(alpha):
        from refdgs_pipe.ops import reference_shade

        return weight * reference_shade.normal_smoothness(*given, shaded=shaded)
    count = threads or torch.get_num_threads()
    loss: Tensor = _NormalSmoothness.apply(  # type: ignore[no-untyped-call]
        *given, shaded, weight, count
    )
    return loss


def clip(x: Tensor, limit: float) -> Tensor:
    """min(x, limit) whose gradient above the limit only pulls down.

    So a highlight that is too bright for its photo comes back, and one that the photo clips is not
    pushed up without end.
    """
    out: Tensor = _ClipThatPullsDown.apply(x, limit)  # type: ignore[no-untyped-call]
    return out


def _check_images(size: tuple[int, ...], **images: Tensor | None) -> None:
    given = [(name, image) for name, image in images.items() if image is not None]
    for name, image in given:
        if tuple(image.shape[:2]) != size:
            raise ShapeError(f"{name} is {tuple(image.shape)}: give {size[0]} rows of {size[1]}")
    check_alike(*given)


def _function(name: str, dtype: torch.dtype) -> Any:
    return getattr(native, f"{name}_{'float' if dtype == torch.float32 else 'double'}")


class _ClipThatPullsDown(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, limit: float) -> Tensor:
        ctx.save_for_backward(x > limit)
        return x.clamp(max=limit)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        (over,) = ctx.saved_tensors
        return torch.where(over & (grads[0] < 0), 0.0, grads[0]), None


class _ShadingInputs(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        alpha: Tensor,
        normal: Tensor,
        near: Tensor | None,
        pixels: Tensor,
        camera: Pinhole,
        threads: int,
    ) -> tuple[Tensor, ...]:
        count, channels = len(pixels), features.shape[2]
        planes = [features.new_empty(width, count) for width in (3, 1, 3, 1)]
        diffuse, roughness, reflected, cosine = planes
        out = [diffuse.T, roughness[0], reflected.T, cosine[0]]
        out.append(features.new_empty(count, 4 if near is not None else 0))
        images = [addresses.image(t) for t in (features, alpha, normal, near)]
        head = (
            [*alpha.shape],
            addresses.lens_and_rotation(camera),
            count,
            pixels.data_ptr(),
            channels,
            images,
        )
        ctx.head = (*head, threads)
        _function("shading_inputs", features.dtype)(*ctx.head, [addresses.table(t) for t in out])
        ctx.save_for_backward(features, alpha, normal, near, pixels)
        return tuple(out)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        features, alpha, _, near, _ = ctx.saved_tensors
        widths = (features.shape[2], 1, 3, 4 if near is not None else 0)
        grads = [alpha.new_empty(width, *alpha.shape) for width in widths]
        _function("shading_inputs_bwd", alpha.dtype)(
            *ctx.head, [addresses.table(t) for t in v], [t.data_ptr() for t in grads]
        )
        v_features, v_alpha, v_normal, v_near = (g.permute(1, 2, 0) for g in grads)
        return (
            v_features,
            v_alpha[..., 0],
            v_normal,
            v_near if near is not None else None,
            *[None] * 3,
        )


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        diffuse: Tensor,
        radiance: Tensor,
        pixels: Tensor,
        object_alpha: Tensor,
        alpha: Tensor,
        backdrop: Tensor,
        behind: Tensor | None,
        threads: int,
    ) -> Tensor:
        planes = alpha.new_empty(3, *alpha.shape)
        images = [addresses.image(t) for t in (object_alpha, alpha, behind)]
        tables = [addresses.table(t) for t in (diffuse, radiance)]
        head = [[*alpha.shape], len(pixels), pixels.data_ptr(), tables, images]
        head += [backdrop.tolist(), threads]
        _function("composite", alpha.dtype)(*head, planes.data_ptr())
        ctx.save_for_backward(diffuse, radiance, pixels, object_alpha, alpha)
        ctx.head, ctx.behind = head, behind is not None
        return planes.permute(1, 2, 0)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        diffuse, _, pixels, _, alpha = ctx.saved_tensors
        linear = diffuse.new_empty(3, len(pixels))
        v_object, v_alpha = alpha.new_empty(alpha.shape), alpha.new_empty(alpha.shape)
        _function("composite_bwd", alpha.dtype)(
            *ctx.head, [addresses.image(v[0])], [t.data_ptr() for t in (linear, v_object, v_alpha)]
        )
        v_linear, behind = linear.T, v[0] if ctx.behind else None
        return v_linear, v_linear, None, v_object, v_alpha, None, behind, None


class _NormalAgreement(torch.autograd.Function):
    """The loss is a scalar, so forward computes the whole gradient and backward scales it."""

    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        depth: Tensor,
        alpha: Tensor,
        camera: Pinhole,
        edge: float,
        weight: float,
        threads: int,
    ) -> Tensor:
        height, width = alpha.shape
        scale = weight / ((height - 2) * (width - 2))
        grads: list[Tensor] = []
        if any(ctx.needs_input_grad):
            grads = [alpha.new_empty(channels, height, width) for channels in (3, 1, 1)]
        total: float = _function("normal_agreement", alpha.dtype)(
            [height, width],
            addresses.lens_and_rotation(camera),
            [addresses.image(t) for t in (normal, depth, alpha)],
            scale,
            edge,
            threads,
            [t.data_ptr() for t in grads] or [0] * 3,
        )
        ctx.grads = grads
        return alpha.new_tensor(total * scale)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        scale = float(v[0])
        v_normal, v_depth, v_alpha = (g if scale == 1 else g * scale for g in ctx.grads)
        return v_normal.permute(1, 2, 0), v_depth[0], v_alpha[0], *[None] * 4


class _NormalSmoothness(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        normal: Tensor,
        features: Tensor,
        depth: Tensor,
        alpha: Tensor,
        object_alpha: Tensor,
        shaded: float,
        weight: float,
        threads: int,
    ) -> Tensor:
        height, width = alpha.shape
        ctx.gradient = alpha.new_empty(3, height, width) if ctx.needs_input_grad[0] else None
        total: float = _function("normal_smoothness", alpha.dtype)(
            [height, width],
            [addresses.image(t) for t in (normal, features, depth, alpha, object_alpha)],
            [shaded, weight / (height * (width - 1)), weight / ((height - 1) * width)],
            threads,
            0 if ctx.gradient is None else ctx.gradient.data_ptr(),
        )
        return alpha.new_tensor(total)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        scale, gradient = float(v[0]), ctx.gradient
        scaled = gradient if scale == 1 else gradient * scale
        return scaled.permute(1, 2, 0), *[None] * 7
