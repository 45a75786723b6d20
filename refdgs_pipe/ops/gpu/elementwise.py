"""What lies between the other operations, on a GPU; nothing waits for it."""

from functools import cache
from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda
from refdgs_pipe.ops.definition.elementwise import CURVES, Observed

MEAN_BLOCK = 1024  # numbers whose sum is one part


@cache
def _one(device: torch.device, dtype: torch.dtype) -> Tensor:
    return torch.ones((), device=device, dtype=dtype)


def unit(like: Tensor) -> Tensor:
    """() 1, always the same tensor: what is told by it need not be scaled."""
    return _one(like.device, like.dtype)


def scaled(gradient: Tensor, v: Tensor) -> Tensor:
    """A gradient that is kept, times the loss's: () or, of parts, the same for all of them."""
    if addresses.of(v) == addresses.of(unit(v)):
        return gradient
    return gradient * v.reshape(-1)[:1].reshape(())


class Total(torch.autograd.Function):
    """Parts of all terms in one sum."""

    @staticmethod
    def forward(ctx: Any, *terms: Tensor) -> Tensor:
        ctx.shapes = [term.shape for term in terms]
        out = terms[0].new_empty(())
        given = [term.contiguous() for term in terms]
        cuda.kernels("total", out)(
            addresses.each(given), [term.numel() for term in given], addresses.of(out)
        )
        return out

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor, ...]:
        return tuple(v[0].expand(shape) for shape in ctx.shapes)


class ImageMean(torch.autograd.Function):
    """The gradient is one number for all pixels."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, weight: float, divisor: float, whole: bool) -> Tensor:
        ctx.shape = image.shape
        parts, ctx.slope = _parts(image, None, weight / divisor / image.numel())
        return parts.sum() if whole else parts

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        return scaled(ctx.slope, v[0]).expand(ctx.shape), None, None, None


class Mirrored(torch.autograd.Function):
    """The same of radiance; in rows of no pixel the gradient has no meaning."""

    @staticmethod
    def forward(
        ctx: Any, radiance: Tensor, pixels: Tensor, count: int, weight: float, whole: bool
    ) -> Tensor:
        ctx.shape = radiance.shape
        parts, ctx.slope = _parts(radiance, pixels, weight / (3 * count))
        return parts.sum() if whole else parts

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        return scaled(ctx.slope, v[0]).expand(ctx.shape), *[None] * 4


def _parts(image: Tensor, pixels: Tensor | None, scale: float) -> tuple[Tensor, Tensor]:
    """Parts of `scale` times the sum, and () the scale."""
    parts = image.new_empty(max(1, -(-image.numel() // MEAN_BLOCK)))
    slope = image.new_empty(())
    cuda.kernels("image_mean", image)(
        [*image.shape],
        [addresses.image(image)],
        addresses.of(pixels),
        scale,
        addresses.each((parts, slope)),
    )
    return parts, slope


class Activated(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        curves: tuple[str, ...],
        log_scales: Tensor,
        raw_opacities: Tensor,
        *tables: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        raw = [t.contiguous() for t in (log_scales, raw_opacities, *tables)]
        n = len(log_scales)
        columns = [1 if t.ndim == 1 else t.shape[1] for t in tables]
        out = (raw[0].new_empty(n, 2), raw[1].new_empty(n), raw[0].new_empty(n, sum(columns)))
        ctx.call = columns, [CURVES.index(curve) for curve in curves]
        cuda.kernels("activated", out[1])(n, addresses.each(raw), *ctx.call, addresses.each(out))
        ctx.save_for_backward(*raw, *out)
        return out

    @staticmethod
    def backward(ctx: Any, *v: Tensor) -> tuple[Tensor | None, ...]:
        raw, out = ctx.saved_tensors[:-3], ctx.saved_tensors[-3:]
        grads = [torch.empty_like(t) for t in raw]
        given = [t.contiguous() for t in v]
        cuda.kernels("activated_bwd", out[1])(
            len(out[1]),
            addresses.each(raw),
            *ctx.call,
            *(addresses.each(of) for of in (out, given, grads)),
        )
        return None, *grads


def observe(sets: list[Observed], scale: float, misfit: Tensor | None) -> None:
    """`ops.observe`."""
    given = [
        (total, seen, gradients.contiguous(), radii.contiguous())
        for total, seen, gradients, radii in sets
    ]
    cuda.kernels("observe", sets[0][0])(
        [address for tensors in given for address in addresses.each(tensors)],
        [len(total) for total, *_ in given],
        scale,
        addresses.of(misfit),
    )


def damped(grad: Tensor, mirrored: Tensor, diffuse: Tensor, share: float) -> Tensor:
    """`ops.damped`."""
    planes = grad.new_empty(3, len(grad))
    tables = [addresses.table(t) for t in (grad, mirrored, diffuse)]
    cuda.kernels("damped", grad)(len(grad), tables, share, addresses.of(planes))
    return planes.T
