"""Sph-Mip lookups on a GPU; nothing waits for it."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda

QUAD = 16  # bytes that kernels read at once


class SphMip(torch.autograd.Function):
    """Lookups; the mips are made anew and kept for backward."""

    @staticmethod
    def forward(
        ctx: Any,
        base: Tensor,
        directions: Tensor,
        roughness: Tensor,
        levels: int,
        min_level: float,
        limit: Tensor | None,
        threads: int,
    ) -> Tensor:
        base = addresses.aligned(base, QUAD)
        height, width, channels = base.shape
        coarser = sum((height >> level) * (width >> level) for level in range(1, levels))
        mips = base.new_empty(coarser, channels)
        coordinates = base.new_empty(3, len(directions))
        features = base.new_empty(len(directions), channels)
        tensors = (base, mips, directions, roughness, coordinates)
        ctx.call, ctx.limit = ([height, width, levels], len(directions), min_level), limit
        cuda.kernels("sph_mip", base)(
            *ctx.call, *_inputs(*tensors), *addresses.each((limit, features))
        )
        ctx.save_for_backward(*tensors)
        return features

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        base, mips, directions, roughness, coordinates = ctx.saved_tensors
        v_features = addresses.aligned(grads[0], QUAD)
        v_base = torch.empty_like(base) if ctx.needs_input_grad[0] else None
        v_directions = directions.new_empty(directions.shape)
        v_roughness = roughness.new_empty(roughness.shape)
        bits = cuda.memory(0 if v_base is None else 8 * (base.numel() + mips.numel()), base)
        scale = cuda.memory(4, base)
        cuda.kernels("sph_mip_bwd", base)(
            *ctx.call,
            *_inputs(base, mips, directions, roughness, coordinates),
            *addresses.each((ctx.limit, v_features)),
            addresses.each((v_base, v_directions, v_roughness)),
            addresses.each((None if v_base is None else bits, scale)),
        )
        return v_base, v_directions, v_roughness, *[None] * 4


def _inputs(*tensors: Tensor) -> tuple[list[int], list[int]]:
    _, _, directions, roughness, _ = tensors
    return addresses.each(tensors), [*directions.stride(), *roughness.stride()]
