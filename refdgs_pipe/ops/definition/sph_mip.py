"""Sph-Mip lookups in plain torch."""

import math

import torch
from torch import Tensor

POLE_SINE = 1e-3


def mips(base: Tensor) -> list[Tensor]:
    """The (H, W, C) map and its 2 x 2 box averages, down to 2 texels on the shorter side."""
    levels = [base]
    while min(levels[-1].shape[:2]) > 2:
        finer = levels[-1].permute(2, 0, 1)
        levels.append(torch.nn.functional.avg_pool2d(finer, 2).permute(1, 2, 0))
    return levels


def polar(directions: Tensor) -> tuple[Tensor, Tensor]:
    """u, v in 0..1 of (P, 3) directions: azimuth from +x towards +y, angle from +z.

    Nearer to a pole than 0.06 degrees the azimuth's gradient is damped: it would have no bound.
    """
    x, y, z = directions.unbind(-1)
    r2 = x * x + y * y
    phi = torch.atan2(y, x).detach()
    along = (x.detach() * y - y.detach() * x) / r2.detach().clamp(min=POLE_SINE**2)
    theta = torch.atan2(torch.sqrt(r2 + 1e-24), z)
    turns = phi / (2 * math.pi)
    u = torch.where(turns < 0, turns + 1, turns) + along / (2 * math.pi)
    return u, theta / math.pi


def bilinear(level: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """(P, C) values of an (h, w, C) level; past a pole comes the same row on the other side."""
    h, w = level.shape[:2]
    x, y = u * w - 0.5, v * h - 0.5
    column, row = torch.floor(x.detach()).long(), torch.floor(y.detach()).long()
    row = row.clamp(-1, h - 1)
    wx, wy = (x - column)[:, None], (y - row)[:, None]

    def texel(i: Tensor, j: Tensor) -> Tensor:
        over = (i < 0) | (i >= h)
        return level[i.clamp(0, h - 1), torch.where(over, j + w // 2, j) % w]

    above = (1 - wx) * texel(row, column) + wx * texel(row, column + 1)
    below = (1 - wx) * texel(row + 1, column) + wx * texel(row + 1, column + 1)
    return (1 - wy) * above + wy * below


def sph_mip(
    base: Tensor,
    directions: Tensor,
    roughness: Tensor,
    levels: int,
    min_level: float,
    limit: Tensor | None = None,
    threads: int = 1,
) -> Tensor:
    """`ops.sph_mip`."""
    pyramid = mips(base)
    u, v = polar(directions)
    level = (len(pyramid) * roughness).clamp(min_level, len(pyramid) - 1)
    fine = level.detach().long()
    values = torch.stack([bilinear(mip, u, v) for mip in pyramid])
    index = torch.arange(len(u))
    coarse = (fine + 1).clamp(max=len(pyramid) - 1)
    blend = (level - fine)[:, None]
    return (1 - blend) * values[fine, index] + blend * values[coarse, index]
