"""Deferred shading on a GPU, behind autograd; nothing waits for it."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import cuda
from refdgs_pipe.ops.rasterize import Pinhole

AGREEMENT_BLOCK = 256  # pixels whose part of the sum is one


def numbers_of(camera: Pinhole) -> list[float]:
    """Lens and the rotation from the camera to the world."""
    rotation = camera.cam_from_world[:3, :3].detach().double().T.flatten().tolist()
    return [camera.fx, camera.fy, camera.cx, camera.cy, *rotation]


class ShadingInputs(torch.autograd.Function):
    """carried, reflected, cosine (P, 1) and near (P, 4 or 0)."""

    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        alpha: Tensor,
        normal: Tensor,
        near: Tensor | None,
        pixels: Tensor,
        camera: Pinhole,
    ) -> tuple[Tensor, ...]:
        count = len(pixels)
        widths = (4, 3, 1, 4 if near is not None else 0)
        out = [features.new_empty(count, width) for width in widths]
        images = [cuda.image(t) for t in (features, alpha, normal, near)]
        ctx.head = ([*alpha.shape], numbers_of(camera), count, pixels.data_ptr(), images)
        cuda.kernels("shading_inputs", alpha)(*ctx.head, [t.data_ptr() for t in out])
        ctx.save_for_backward(features, alpha, normal, near, pixels)
        return out[0], out[1], out[2][:, 0], out[3]

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        features, alpha, _, near, _ = ctx.saved_tensors
        given = [t.contiguous() for t in v]
        widths = (features.shape[2], 1, 3, 4 if near is not None else 0)
        grads = [alpha.new_zeros(width, *alpha.shape) for width in widths]
        cuda.kernels("shading_inputs_bwd", alpha)(
            *ctx.head, [t.data_ptr() for t in given], [t.data_ptr() for t in grads]
        )
        v_features, v_alpha, v_normal, v_near = (g.permute(1, 2, 0) for g in grads)
        last = v_near if near is not None else None
        return v_features, v_alpha[..., 0], v_normal, last, None, None


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
    ) -> Tensor:
        diffuse = diffuse if diffuse.stride(1) == 1 else diffuse.contiguous()
        radiance, backdrop = radiance.contiguous(), backdrop.to(alpha).contiguous()
        planes = alpha.new_empty(3, *alpha.shape)
        rows = [t.data_ptr() for t in (pixels, diffuse, radiance)]
        images = [cuda.image(t) for t in (object_alpha, alpha, behind)]
        size = [*alpha.shape]
        ctx.head = (size, len(pixels), rows, diffuse.stride(0), images, backdrop.data_ptr())
        cuda.kernels("composite", alpha)(*ctx.head, planes.data_ptr())
        ctx.save_for_backward(diffuse, radiance, pixels, object_alpha, alpha, behind, backdrop)
        return planes.permute(1, 2, 0)

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        _, radiance, _, _, alpha, behind, _ = ctx.saved_tensors
        linear = radiance.new_empty(radiance.shape)
        v_object, v_alpha = alpha.new_empty(alpha.shape), alpha.new_empty(alpha.shape)
        cuda.kernels("composite_bwd", alpha)(
            *ctx.head, [cuda.image(v[0])], [t.data_ptr() for t in (linear, v_object, v_alpha)]
        )
        v_behind = None if behind is None else v[0]
        return linear, linear, None, v_object, v_alpha, None, v_behind


class NormalAgreement(torch.autograd.Function):
    """Forward computes the whole gradient of the scalar and backward scales it."""

    @staticmethod
    def forward(ctx: Any, normal: Tensor, depth: Tensor, alpha: Tensor, camera: Pinhole) -> Tensor:
        height, width = alpha.shape
        scale = 1.0 / ((height - 2) * (width - 2))
        grads: list[Tensor] = []
        if any(ctx.needs_input_grad):
            grads = [alpha.new_empty(channels, height, width) for channels in (3, 1, 1, 6)]
        blocks = -(-height * width // AGREEMENT_BLOCK)
        parts, total = cuda.memory(blocks * alpha.itemsize, alpha), alpha.new_empty(1)
        cuda.kernels("normal_agreement", alpha)(
            [height, width],
            numbers_of(camera),
            [cuda.image(t) for t in (normal, depth, alpha)],
            scale,
            [t.data_ptr() for t in grads] or [0] * 4,
            [parts.data_ptr(), total.data_ptr()],
        )
        ctx.grads = grads[:3]
        return total[0] * scale

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        v_normal, v_depth, v_alpha = (g * v[0] for g in ctx.grads)
        return v_normal.permute(1, 2, 0), v_depth[0], v_alpha[0], None
