"""Deferred shading on the CPU."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses
from refdgs_pipe.ops.native import kernels
from refdgs_pipe.ops.scene import Pinhole


class ShadingInputs(torch.autograd.Function):
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
            addresses.of(pixels),
            channels,
            images,
        )
        ctx.head = (*head, threads)
        kernels("shading_inputs", features)(*ctx.head, [addresses.table(t) for t in out])
        ctx.save_for_backward(features, alpha, normal, near, pixels)
        return tuple(out)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        features, alpha, _, near, _ = ctx.saved_tensors
        widths = (features.shape[2], 1, 3, 4 if near is not None else 0)
        grads = [alpha.new_empty(width, *alpha.shape) for width in widths]
        kernels("shading_inputs_bwd", alpha)(
            *ctx.head, [addresses.table(t) for t in v], addresses.each(grads)
        )
        v_features, v_alpha, v_normal, v_near = (g.permute(1, 2, 0) for g in grads)
        return (
            v_features,
            v_alpha[..., 0],
            v_normal,
            v_near if near is not None else None,
            *[None] * 3,
        )


class Composite(torch.autograd.Function):
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
        head = [[*alpha.shape], len(pixels), addresses.of(pixels), tables, images]
        head += [backdrop.tolist(), threads]
        kernels("composite", alpha)(*head, addresses.of(planes))
        ctx.save_for_backward(diffuse, radiance, pixels, object_alpha, alpha)
        ctx.head, ctx.behind = head, behind is not None
        return planes.permute(1, 2, 0)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        diffuse, _, pixels, _, alpha = ctx.saved_tensors
        linear = diffuse.new_empty(3, len(pixels))
        v_object, v_alpha = alpha.new_empty(alpha.shape), alpha.new_empty(alpha.shape)
        kernels("composite_bwd", alpha)(
            *ctx.head, [addresses.image(v[0])], addresses.each((linear, v_object, v_alpha))
        )
        v_linear, behind = linear.T, v[0] if ctx.behind else None
        return v_linear, v_linear, None, v_object, v_alpha, None, behind, None


class NormalAgreement(torch.autograd.Function):
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
        whole: bool,
        threads: int,
    ) -> Tensor:
        height, width = alpha.shape
        scale = weight / ((height - 2) * (width - 2))
        grads: list[Tensor] = []
        if any(ctx.needs_input_grad):
            grads = [alpha.new_empty(channels, height, width) for channels in (3, 1, 1)]
        total: float = kernels("normal_agreement", alpha)(
            [height, width],
            addresses.lens_and_rotation(camera),
            [addresses.image(t) for t in (normal, depth, alpha)],
            scale,
            edge,
            threads,
            addresses.each(grads or [None] * 3),
        )
        ctx.grads = grads
        return alpha.new_tensor(total * scale)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        scale = float(v[0])
        v_normal, v_depth, v_alpha = (g if scale == 1 else g * scale for g in ctx.grads)
        return v_normal.permute(1, 2, 0), v_depth[0], v_alpha[0], *[None] * 5


class NormalSmoothness(torch.autograd.Function):
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
        whole: bool,
        threads: int,
    ) -> Tensor:
        height, width = alpha.shape
        ctx.gradient = alpha.new_empty(3, height, width) if ctx.needs_input_grad[0] else None
        total: float = kernels("normal_smoothness", alpha)(
            [height, width],
            [addresses.image(t) for t in (normal, features, depth, alpha, object_alpha)],
            [shaded, weight / (height * (width - 1)), weight / ((height - 1) * width)],
            threads,
            addresses.of(ctx.gradient),
        )
        return alpha.new_tensor(total)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        scale, gradient = float(v[0]), ctx.gradient
        scaled = gradient if scale == 1 else gradient * scale
        return scaled.permute(1, 2, 0), *[None] * 8
