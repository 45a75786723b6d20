"""The Sph-Mip encoding: features of a distant environment by direction and roughness."""

import torch
from torch import Tensor

from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops.checks import check_alike
from refdgs_pipe.ops.cpu import sph_mip as on_cpu
from refdgs_pipe.ops.definition import sph_mip as definition
from refdgs_pipe.ops.gpu import sph_mip as on_gpu
from refdgs_pipe.ops.registry import Operation

CHANNELS = 4

_SPH_MIP = Operation("sph_mip", definition.sph_mip, on_cpu.SphMip, on_gpu.SphMip)


def mip_levels(height: int, width: int) -> int:
    """Levels of a map, the finest included: 9 for 512 x 1024; the coarsest is 2 texels high."""
    return min(height, width).bit_length() - 1


def sph_mip(
    base: Tensor,
    directions: Tensor,
    roughness: Tensor,
    *,
    min_level: float = 0.0,
    threads: int | None = None,
    limit: Tensor | None = None,
) -> Tensor:
    """Trilinear lookups in a lat-long map and its box-averaged mips (Ref-GS, Ref-DGS).

    The pole is +z: v = angle from +z / pi down the rows, u = azimuth from +x towards +y / 2 pi
    along the columns, texel centres at (i + 0.5) / size. The azimuth wraps; past a pole lies the
    same row on the other side, so nothing is clamped and no gradient dies. The level is
    `levels * roughness` within min_level..levels - 1. Gradients go to all three tensors; the
    azimuth's is damped within 0.06 degrees of the poles, where it has no bound. The mips are made
    anew by every call: ask for all directions in one.

    Args:
        base: (H, W, 4) the map; H and W powers of two, at least 2.
        directions: (P, 3), any length but zero.
        roughness: (P,) in 0..1.
        min_level: the finest level that is used.
        threads: default torch's; the result does not depend on it.
        limit: (1,) int64 on a GPU: no more than the first that many rows are looked at there, and
            what is made of the others has no meaning.

    Returns:
        (P, 4) features.

    Raises:
        ShapeError: sizes or types disagree, H or W is no power of two, or there is no such level.
    """
    _check(base, directions, roughness, min_level)
    count = threads or torch.get_num_threads()
    features: Tensor = _SPH_MIP.kernel(base)(
        base, directions, roughness, mip_levels(*base.shape[:2]), min_level, limit, count
    )
    return features


def _check(base: Tensor, directions: Tensor, roughness: Tensor, min_level: float) -> None:
    shape = tuple(base.shape)
    if len(shape) != 3 or shape[2] != CHANNELS or any(n < 2 or n & (n - 1) for n in shape[:2]):
        raise ShapeError(f"base is {shape}: give (H, W, {CHANNELS}), H and W powers of two from 2")
    if directions.ndim != 2 or directions.shape[1] != 3:
        raise ShapeError(f"directions is {tuple(directions.shape)}: give (P, 3)")
    if roughness.shape != directions.shape[:1]:
        raise ShapeError(
            f"roughness is {tuple(roughness.shape)} but directions has P = {len(directions)}: "
            "give (P,)"
        )
    check_alike(("base", base), ("directions", directions), ("roughness", roughness))
    last = mip_levels(*shape[:2]) - 1
    if not 0 <= min_level <= last:
        raise ShapeError(f"min_level is {min_level}: a map of {shape} has levels 0 to {last}")
