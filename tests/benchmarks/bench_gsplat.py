"""Our rasteriser and gsplat's torch reference of 2DGS on the same discs, one thread, core-ms.

    pip install gsplat nerfacc jaxtyping   # optional; skipped without
    pytest -m benchmark -s tests/benchmarks/bench_gsplat.py

The reference is handed the pairs of discs and pixels that count, nearest first; finding them is not
timed. Its weights come from nerfacc, which has no CPU version of that scan: it gets one in torch.
Ours is timed with projection, sorting and binning.
"""

import statistics
from functools import partial
from typing import Any

import pytest
import torch
from bench_rasterize import camera, core_ms, ours, sphere_scene
from torch import Tensor

pytestmark = pytest.mark.benchmark
SIZE, SURFELS, REPEATS = 400, 20_000, 5


def pairs(means2d: Tensor, rows: Tensor, opacities: Tensor, radii: Tensor, depths: Tensor) -> Any:
    """Disc and pixel ids of alpha above 1/255, by pixel and then by depth."""
    low = (means2d - radii).floor().clamp(0, SIZE - 1).long()
    high = (means2d + radii).ceil().clamp(0, SIZE - 1).long()
    width, height = ((high - low + 1) * (radii > 0)).unbind(-1)
    count = width * height
    disc = torch.repeat_interleave(torch.arange(len(count)), count)
    step = torch.arange(len(disc)) - torch.repeat_interleave(count.cumsum(0) - count, count)
    x, y = low[disc, 0] + step % width[disc], low[disc, 1] + step // width[disc]
    px, py = x + 0.5, y + 0.5
    u_row, v_row, w_row = rows[disc].unbind(1)
    hit = torch.linalg.cross(px[:, None] * w_row - u_row, py[:, None] * w_row - v_row)
    on_disc = (hit[:, :2] / hit[:, 2:]).square().sum(-1)
    off = 2 * ((px - means2d[disc, 0]) ** 2 + (py - means2d[disc, 1]) ** 2)
    alpha = opacities[disc] * torch.exp(-0.5 * torch.minimum(on_disc, off))
    kept = alpha > 1 / 255
    disc, pixel = disc[kept], (y * SIZE + x)[kept]
    order = torch.argsort(depths[disc], stable=True)
    order = order[torch.argsort(pixel[order], stable=True)]
    return disc[order], pixel[order]


def weights_of(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Blending weights and transmittance (pairs,) of alphas sorted by ray."""
    through = torch.log1p(-alphas.clamp(max=0.999))
    before = through.cumsum(0) - through
    first = torch.searchsorted(ray_indices, ray_indices)
    transmittance = torch.exp(before - before[first])
    return alphas * transmittance, transmittance


def test_against_gsplats_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("gsplat")
    nerfacc = pytest.importorskip("nerfacc")
    monkeypatch.setattr(nerfacc, "render_weight_from_alpha", weights_of)
    from gsplat.cuda._torch_impl_2dgs import (  # type: ignore[import-not-found]
        _fully_fused_projection_2dgs,
        accumulate_2dgs,
    )

    torch.set_num_threads(1)
    surfels, features = sphere_scene(SURFELS)
    view = camera(SIZE)
    K = torch.tensor([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1.0]])[None]
    scales = torch.cat([surfels.scales, torch.ones(SURFELS, 1)], -1)
    pose = view.cam_from_world[None]
    with torch.no_grad():
        radii, means2d, depths, rows, normals = _fully_fused_projection_2dgs(
            surfels.means, surfels.quats, scales, pose, K, SIZE, SIZE
        )
        size = radii[0] if radii.ndim == 3 else radii[0][:, None].expand(-1, 2)
        disc, pixel = pairs(means2d[0], rows[0], surfels.opacities, size, depths[0])
    colors = torch.cat([features, torch.rand(SURFELS, 1)], -1)[None]  # 9 channels and the normal
    tensors = (means2d, rows, surfels.opacities[None], colors, normals)
    leaves = [t.detach().clone().requires_grad_() for t in tensors]
    image = torch.zeros_like(disc)
    forwards, backwards = [], []
    for _ in range(REPEATS):
        for leaf in leaves:
            leaf.grad = None
        made: list[Any] = []

        def forward(made: list[Any] = made) -> None:
            made.append(accumulate_2dgs(*leaves, disc, pixel, image, SIZE, SIZE))

        forwards.append(core_ms(forward))
        pulls = [torch.randn_like(t) for t in made[0]]
        backwards.append(core_ms(partial(torch.autograd.backward, made[0], pulls)))
    theirs = statistics.median(forwards), statistics.median(backwards)
    mine = ours(SIZE, SURFELS)
    print(
        f"\n{SIZE}x{SIZE}, {SURFELS} discs, {len(disc)} pairs: ours {mine[0]:.1f} + {mine[1]:.1f}, "
        f"gsplat's torch reference {theirs[0]:.0f} + {theirs[1]:.0f} core-ms, "
        f"{sum(theirs) / sum(mine):.0f}x"
    )
