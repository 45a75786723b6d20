"""Sph-Mip lookups on the CPU."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses
from refdgs_pipe.ops.native import kernels


class SphMip(torch.autograd.Function):
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
        base = base.contiguous()
        height, width, channels = base.shape
        coarser = sum((height >> level) * (width >> level) for level in range(1, levels))
        mips = base.new_empty(coarser, channels)
        coordinates = base.new_empty(3, len(directions))
        features = base.new_empty(len(directions), channels)
        tensors = (base, mips, directions, roughness, coordinates)
        ctx.call = ([height, width, levels], len(directions), min_level)
        kernels("sph_mip", base)(*ctx.call, *_inputs(*tensors), threads, addresses.of(features))
        ctx.save_for_backward(*tensors)
        ctx.threads = threads
        return features

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors
        base, mips, directions, roughness, _ = tensors
        v_base = torch.empty_like(base) if ctx.needs_input_grad[0] else None
        v_mips = torch.empty_like(mips)
        v_directions = directions.new_empty(directions.shape)
        v_roughness = roughness.new_empty(roughness.shape)
        v_features = grads[0].contiguous()
        kernels("sph_mip_bwd", base)(
            *ctx.call,
            *_inputs(*tensors),
            ctx.threads,
            addresses.of(v_features),
            addresses.each((v_base, v_mips, v_directions, v_roughness)),
        )
        return v_base, v_directions, v_roughness, *[None] * 4


def _inputs(*tensors: Tensor) -> tuple[list[int], list[int]]:
    _, _, directions, roughness, _ = tensors
    return addresses.each(tensors), [*directions.stride(), *roughness.stride()]
