"""Deferred shading on a GPU; nothing waits for it."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda
from refdgs_pipe.ops.definition.shade import covered_pixels as counted
from refdgs_pipe.ops.gpu.elementwise import scaled
from refdgs_pipe.ops.plan import Plan
from refdgs_pipe.ops.scene import Pinhole

AGREEMENT_BLOCK = 256  # pixels whose part of the sum is one
SMOOTH_WIDE, SMOOTH_HIGH = 32, 8  # the same of smoothness: a tile


def covered_pixels(alpha: Tensor, least: float, plan: Plan | None) -> Tensor:
    """`ops.covered_pixels`."""
    if plan is None:
        return counted(alpha, least, plan)
    size = [*alpha.shape]
    every = alpha.numel()
    room = plan.room(*size, items=every, most=every, count=lambda: _count(alpha, least))
    pixels = alpha.new_empty(room, dtype=torch.int64)
    sizes = cuda.kernels("covered_sizes", alpha)(size)
    counts, scratch = cuda.memory(sizes[0], alpha), cuda.memory(sizes[1], alpha)
    memory = addresses.each((pixels, counts, scratch))
    image = [addresses.image(alpha)]
    cuda.kernels("covered_pixels", alpha)(size, image, least, room, memory, sizes[1], plan.places())
    return pixels


def _count(alpha: Tensor, least: float) -> int:
    """How many pixels are covered. The first step of an image's size waits for it."""
    return int((alpha > least).sum())


class ShadingInputs(torch.autograd.Function):
    """Diffuse, roughness, mirrored ray, cosine, and near (P, 4 or 0)."""

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
            addresses.lens(camera),
            addresses.of(pixels),
            channels,
            images,
        )
        cuda.kernels("shading_inputs", alpha)(*head, [addresses.table(t) for t in out])
        ctx.save_for_backward(features, alpha, normal, near, pixels)
        ctx.head, ctx.lens = head, camera.lens  # head has addresses: what they are of must stay
        return tuple(out)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        features, alpha, _, near, _ = ctx.saved_tensors
        widths = (features.shape[2], 1, 3, 4 if near is not None else 0)
        # one after the other, so that they are cleared in one go
        grads = alpha.new_empty(sum(widths), *alpha.shape).split(widths)
        cuda.kernels("shading_inputs_bwd", alpha)(
            *ctx.head, [addresses.table(t) for t in v], addresses.each(grads)
        )
        v_features, v_alpha, v_normal, v_near = (g.permute(1, 2, 0) for g in grads)
        last = v_near if near is not None else None
        return v_features, v_alpha[..., 0], v_normal, last, *[None] * 3


class Composite(torch.autograd.Function):
    """The picture, (H, W, 3)."""

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
        backdrop = backdrop.to(alpha).contiguous()
        planes = alpha.new_empty(3, *alpha.shape)
        tables = [addresses.table(t) for t in (diffuse, radiance)]
        images = [addresses.image(t) for t in (object_alpha, alpha, behind)]
        where = addresses.of(pixels), tables, images, addresses.of(backdrop)
        head = ([*alpha.shape], len(pixels), *where)
        cuda.kernels("composite", alpha)(*head, addresses.of(planes))
        ctx.save_for_backward(diffuse, radiance, pixels, object_alpha, alpha, behind, backdrop)
        ctx.head, ctx.same = head, object_alpha is alpha
        return planes.permute(1, 2, 0)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        _, radiance, _, _, alpha, behind, _ = ctx.saved_tensors
        linear = radiance.new_empty(len(radiance), 3)
        v_alpha = alpha.new_empty(alpha.shape)
        v_object = v_alpha if ctx.same else alpha.new_empty(alpha.shape)
        cuda.kernels("composite_bwd", alpha)(
            *ctx.head, [addresses.image(v[0])], addresses.each((linear, v_object, v_alpha))
        )
        v_behind = None if behind is None else v[0]
        others = (None if ctx.same else v_object, v_alpha)
        return linear, linear, None, *others, None, v_behind, None


class NormalAgreement(torch.autograd.Function):
    """Forward computes the whole gradient of the scalar and backward scales it."""

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
            grads = [alpha.new_empty(channels, height, width) for channels in (3, 1, 1, 6)]
        blocks = -(-height * width // AGREEMENT_BLOCK)
        parts, total = alpha.new_empty(blocks), alpha.new_empty(()) if whole else None
        cuda.kernels("normal_agreement", alpha)(
            [height, width],
            addresses.lens_and_rotation(camera),
            addresses.lens(camera),
            [addresses.image(t) for t in (normal, depth, alpha)],
            scale,
            edge,
            addresses.each(grads or [None] * 4),
            addresses.each((parts, total)),
        )
        ctx.grads = grads[:3]
        return parts if total is None else total

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        v_normal, v_depth, v_alpha = (scaled(g, v[0]) for g in ctx.grads)
        return v_normal.permute(1, 2, 0), v_depth[0], v_alpha[0], *[None] * 5


class NormalSmoothness(torch.autograd.Function):
    """The same with the gradient by the normal, the only one."""

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
        tiles = -(-height // SMOOTH_HIGH) * -(-width // SMOOTH_WIDE)
        parts, loss = alpha.new_empty(tiles), alpha.new_empty(()) if whole else None
        cuda.kernels("normal_smoothness", alpha)(
            [height, width],
            [addresses.image(t) for t in (normal, features, depth, alpha, object_alpha)],
            [shaded, weight / (height * (width - 1)), weight / ((height - 1) * width)],
            addresses.of(ctx.gradient),
            addresses.each((parts, loss)),
        )
        return parts if loss is None else loss

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        return scaled(ctx.gradient, v[0]).permute(1, 2, 0), *[None] * 8
