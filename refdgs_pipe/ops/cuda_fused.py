"""Image loss, the shader's network and Sph-Mip on a GPU, behind autograd; nothing waits for it."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda

LOSS_TILE, LOSS_SUMS = 16, 3  # pixels along the edge of a block's tile; its sums
MLP_POINTS, MLP_HIDDEN = 64, 64  # points of a block's tile; width of hidden layers
BLOCKS_PER_PROCESSOR = 3
TENSOR_CORES = True  # for the network's hidden layers; else fused multiply-adds
QUAD = 16  # bytes that kernels read at once


def compare(
    image: Tensor,
    target: Tensor,
    weight: Tensor | None,
    each: Tensor,
    shares: tuple[float, float],
    *,
    gradient: Tensor | None = None,
    ssim: Tensor | None = None,
    loss: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """(3,) weighted sums of |image - target|, of SSIM and of (image - target)^2.

    Fills `gradient` and `ssim`, (C, H, W), and `loss`, its two scalars of the loss and the mean
    squared error, where they are given.

    Args:
        each: (1,) what one unit of weight counts for in the loss.
        shares: of the first two sums in the loss.
    """
    height, width, channels = image.shape
    blocks = channels * -(-height // LOSS_TILE) * -(-width // LOSS_TILE)
    sums = image.new_empty(LOSS_SUMS)
    slopes = cuda.memory(0 if gradient is None else 3 * image.numel() * image.itemsize, image)
    parts = cuda.memory(LOSS_SUMS * blocks * image.itemsize, image)
    outputs = [0 if gradient is None else slopes.data_ptr()]
    outputs += [0 if t is None else t.data_ptr() for t in (gradient, ssim)]
    cuda.kernels("image_loss", image)(
        list(image.shape),
        [addresses.image(image), addresses.image(target)],
        [0 if weight is None else weight.data_ptr(), each.data_ptr()],
        list(shares),
        [*outputs, parts.data_ptr(), sums.data_ptr(), *(t.data_ptr() for t in loss or ())]
        + ([0, 0] if loss is None else []),
    )
    return sums


class ImageLoss(torch.autograd.Function):
    """The loss and the mean squared error; forward computes the whole gradient of the first."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, target: Tensor, weight: Tensor | None, share: float
    ) -> tuple[Tensor, Tensor]:
        weight = None if weight is None else weight.contiguous()
        height, width, channels = image.shape
        if weight is None:
            each = image.new_full((1,), 1.0 / image.numel() if image.numel() else 0.0)
        else:
            total = weight.sum().reshape(1) * channels
            each = torch.where(total > 0, 1 / total, 0.0)
        needed = ctx.needs_input_grad[0]
        ctx.gradient = image.new_empty(channels, height, width) if needed else None
        shares, loss = (1 - share, -share), (image.new_empty(()), image.new_empty(()))
        compare(image, target, weight, each, shares, gradient=ctx.gradient, loss=loss)
        ctx.mark_non_differentiable(loss[1])
        return loss

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return (ctx.gradient * grads[0]).permute(1, 2, 0), None, None, None


class Mlp(torch.autograd.Function):
    """Keeps x and the result; hidden values are computed again."""

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, exp_cap: float | None, limit: Tensor | None, *parameters: Tensor
    ) -> Tensor:
        parameters = tuple(t.contiguous() for t in parameters)
        layers, outputs = len(parameters) // 2, len(parameters[-1])
        out = x.new_empty(len(x), outputs)
        tiles = -(-len(x) // MLP_POINTS)
        blocks = min(tiles, BLOCKS_PER_PROCESSOR * cuda.processors(x))
        ctx.shape = [*x.shape, layers - 1, outputs, blocks, int(TENSOR_CORES)]
        ctx.cap, ctx.limit = [] if exp_cap is None else [exp_cap], limit
        cuda.kernels("mlp", x)(*_mlp_call(ctx, x, parameters), out.data_ptr())
        ctx.save_for_backward(x, out, *parameters)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, out, *parameters = ctx.saved_tensors
        hidden_layers, blocks = ctx.shape[2], ctx.shape[4]
        v_out = grads[0].contiguous()
        v_x = x.new_empty(x.shape) if ctx.needs_input_grad[0] else None
        v_parameters = [torch.empty_like(t) for t in parameters]
        numbers = sum(t.numel() for t in parameters)
        hidden = cuda.memory(blocks * hidden_layers * MLP_HIDDEN * MLP_POINTS * x.itemsize, x)
        parts = cuda.memory(blocks * numbers * x.itemsize, x)
        data = [out.data_ptr(), v_out.data_ptr(), 0 if v_x is None else v_x.data_ptr()]
        cuda.kernels("mlp_bwd", x)(
            *_mlp_call(ctx, x, parameters),
            [*data, hidden.data_ptr(), parts.data_ptr()],
            *_halves(v_parameters),
        )
        return v_x, None, None, *v_parameters


def _mlp_call(ctx: Any, x: Tensor, parameters: Sequence[Tensor]) -> tuple[Any, ...]:
    head = (ctx.shape, x.data_ptr(), list(x.stride()), *_halves(parameters), ctx.cap)
    return *head, _address(ctx.limit)


def _address(limit: Tensor | None) -> int:
    return 0 if limit is None else limit.data_ptr()


def _halves(parameters: Sequence[Tensor]) -> tuple[list[int], list[int]]:
    addresses = [t.data_ptr() for t in parameters]
    return addresses[: len(addresses) // 2], addresses[len(addresses) // 2 :]


class SphMip(torch.autograd.Function):
    """Lookups; the mips are made anew and kept for backward."""

    @staticmethod
    def forward(
        ctx: Any,
        base: Tensor,
        directions: Tensor,
        roughness: Tensor,
        levels: int,
        least: float,
        limit: Tensor | None,
    ) -> Tensor:
        base = _quads(base)
        height, width, channels = base.shape
        coarser = sum((height >> level) * (width >> level) for level in range(1, levels))
        mips = base.new_empty(coarser, channels)
        coordinates = base.new_empty(3, len(directions))
        features = base.new_empty(len(directions), channels)
        tensors = (base, mips, directions, roughness, coordinates)
        ctx.call, ctx.limit = ([height, width, levels], len(directions), least), limit
        cuda.kernels("sph_mip", base)(
            *ctx.call, *_mip_inputs(*tensors), _address(limit), features.data_ptr()
        )
        ctx.save_for_backward(*tensors)
        return features

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        base, mips, directions, roughness, coordinates = ctx.saved_tensors
        v_features = _quads(grads[0])
        v_base = torch.empty_like(base) if ctx.needs_input_grad[0] else None
        v_directions = directions.new_empty(directions.shape)
        v_roughness = roughness.new_empty(roughness.shape)
        bits = cuda.memory(0 if v_base is None else 8 * (base.numel() + mips.numel()), base)
        scale = cuda.memory(4, base)
        outputs = [0 if v_base is None else v_base.data_ptr()]
        cuda.kernels("sph_mip_bwd", base)(
            *ctx.call,
            *_mip_inputs(base, mips, directions, roughness, coordinates),
            _address(ctx.limit),
            v_features.data_ptr(),
            [*outputs, v_directions.data_ptr(), v_roughness.data_ptr()],
            [0 if v_base is None else bits.data_ptr(), scale.data_ptr()],
        )
        return v_base, v_directions, v_roughness, None, None, None


def _mip_inputs(*tensors: Tensor) -> tuple[list[int], list[int]]:
    _, _, directions, roughness, _ = tensors
    return [t.data_ptr() for t in tensors], [*directions.stride(), *roughness.stride()]


def _quads(tensor: Tensor) -> Tensor:
    """The tensor, contiguous and starting where kernels may read four numbers at once."""
    whole = tensor.contiguous()
    return whole.clone() if whole.data_ptr() % QUAD else whole
