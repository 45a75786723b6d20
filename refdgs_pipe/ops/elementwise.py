"""What lies between the other operations: on a GPU one launch each, where torch takes several."""

from collections.abc import Sequence

import torch
from torch import Tensor

from refdgs_pipe.ops.definition import elementwise as definition
from refdgs_pipe.ops.definition.elementwise import Observed, diffuse_of
from refdgs_pipe.ops.gpu import elementwise as on_gpu
from refdgs_pipe.ops.registry import Operation, backend_of

__all__ = [
    "activated",
    "damped",
    "descend",
    "diffuse_of",
    "image_mean",
    "mirrored",
    "observe",
    "total",
]

_TOTAL = Operation("total", definition.total, definition.total, on_gpu.Total)
_IMAGE_MEAN = Operation(
    "image_mean", definition.image_mean, definition.image_mean, on_gpu.ImageMean
)
_MIRRORED = Operation("mirrored", definition.mirrored, definition.mirrored, on_gpu.Mirrored)
_ACTIVATED = Operation("activated", definition.activated, definition.activated, on_gpu.Activated)
_OBSERVE = Operation("observe", definition.observe, definition.observe, on_gpu.observe)
_DAMPED = Operation("damped", definition.damped, definition.damped, on_gpu.damped)


def total(terms: Sequence[Tensor]) -> Tensor:
    """The sum of all terms; a scalar.

    Args:
        terms: scalars, and the parts (any number,) that losses give for `whole=False`.
    """
    whole: Tensor = _TOTAL.kernel(terms[0])(*terms)
    return whole


def descend(loss: Tensor) -> None:
    """`loss.backward()`. On a GPU it saves the multiplication of kept gradients by 1."""
    unit = on_gpu.unit(loss) if backend_of(loss) == "gpu" else None
    loss.backward(unit)  # type: ignore[no-untyped-call]


def image_mean(
    image: Tensor, *, weight: float = 1.0, divisor: float = 1.0, whole: bool = True
) -> Tensor:
    """`weight` times the mean of an image (H, W) over `divisor`; a scalar.

    Args:
        whole: false: on a GPU parts of it, for `total` and nothing else.
    """
    mean: Tensor = _IMAGE_MEAN.kernel(image)(image, weight, divisor, whole)
    return mean


def mirrored(
    radiance: Tensor, pixels: Tensor, count: int, *, weight: float = 1.0, whole: bool = True
) -> Tensor:
    """`weight` times the mean specular radiance of a picture, linear; a scalar.

    Args:
        radiance: (P, 3) at `pixels` (P,); rows of no pixel (below 0) count for nothing. On a GPU
            the gradient of such rows has no meaning: give what comes before a `limit`.
        count: pixels of the picture.
        whole: false: on a GPU parts of it, for `total` and nothing else.
    """
    mean: Tensor = _MIRRORED.kernel(radiance)(radiance, pixels, count, weight, whole)
    return mean


def activated(
    log_scales: Tensor, raw_opacities: Tensor, tables: Sequence[tuple[str, Tensor]]
) -> tuple[Tensor, Tensor, Tensor]:
    """Scales (N, 2), opacities (N,), and activated tables side by side (N, C).

    Args:
        log_scales: (N, 2); raw_opacities: (N,).
        tables: up to three (N,) or (N, columns), each with its curve: sigmoid, tanh or diffuse
            (`diffuse_of`).
    """
    curves = tuple(curve for curve, _ in tables)
    out: tuple[Tensor, Tensor, Tensor] = _ACTIVATED.kernel(log_scales)(
        curves, log_scales, raw_opacities, *(table for _, table in tables)
    )
    return out


def observe(sets: Sequence[Observed], *, scale: float, misfit: Tensor | None = None) -> None:
    """Add what a view shows of up to three sets of surfels to what other views showed.

    Args:
        sets: of each the sum of gradients (N,) and the number of views that saw a surfel (N,),
            which change; and `ScreenStatistics` of this view: gradients (N, 2) and radii (N,).
        scale: of the first gradient.
        misfit: () or None; if it is 1, nothing changes (see `Plan`).
    """
    if sets:
        with torch.no_grad():
            _OBSERVE.kernel(sets[0][0])(list(sets), scale, misfit)


def damped(grad: Tensor, mirrored: Tensor, diffuse: Tensor, share: float) -> Tensor:
    """(P, 3) `grad` times the share of mirrored light in all light, over `share`, at most 1.

    Args:
        grad: (P, 3); mirrored, diffuse: (P, 3) linear.
        share: above 0; from this share of mirrored light on, the gradient stays as it is.
    """
    out: Tensor = _DAMPED.kernel(grad)(grad, mirrored, diffuse, share)
    return out
