"""Drawing surfels on a GPU."""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda
from refdgs_pipe.ops.plan import Plan
from refdgs_pipe.ops.scene import (
    EXTRAS,
    Extra,
    Maps,
    Pinhole,
    ScreenStatistics,
    Surfels,
    maps_of,
    planes_of,
)

MOST_ENTRIES = 2**31 - 1
POSE_BLOCK = 128  # surfels whose pose gradients are added first
SHARES = 4  # gradients of one map that the kernels add as they read them


def rasterize(
    surfels: Surfels,
    features: Tensor,
    camera: Pinhole,
    extra: Extra,
    normals: bool,
    needed: Tensor | None,
    absolute: bool,
    threads: int,
    plan: Plan | None,
) -> Maps:
    """`ops.rasterize`; inputs are checked there. All pixels are drawn."""
    n = len(features)
    statistics = ScreenStatistics(features.new_empty(n), features.new_empty(n, 2))
    parts = Rasterize.apply(  # type: ignore[no-untyped-call]
        surfels.means,
        surfels.quats,
        surfels.scales,
        surfels.opacities,
        features,
        camera.cam_from_world,
        camera,
        extra,
        normals,
        absolute,
        plan,
        statistics,
    )
    kinds = len(parts) // SHARES
    shares = [
        maps_of(parts[k : k + kinds], statistics, extra, normals)
        for k in range(0, len(parts), kinds)
    ]
    return replace(shares[0], others=tuple(shares[1:]))


def _entries(by_surfel: Tensor, n: int) -> int:
    """How many entries the patches' lists have. A drawing without a plan waits for it."""
    return int(by_surfel[8 * n : 8 * n + 8].view(torch.int64))


class Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, ...]:
        *tensors, camera, extra, normals, absolute, plan, statistics = args
        inputs = [t.detach().contiguous() for t in tensors[:5]]
        like = inputs[0]
        n, channels = inputs[4].shape
        padded, count = planes_of(channels, extra, normals)
        shape = [n, channels, camera.width, camera.height, EXTRAS[extra], int(normals), 0]
        pointers = addresses.each(inputs)
        posed = (addresses.pose_and_lens(camera), addresses.lens(camera))

        sizes = cuda.kernels("raster_sizes", like)(shape)
        by_surfel, scratch = cuda.memory(sizes[0], like), cuda.memory(sizes[2], like)
        cuda.kernels("raster_project", like)(
            shape,
            pointers,
            *posed,
            *addresses.each((by_surfel, statistics.radii, scratch)),
            sizes[2],
        )
        places = [0, 0]
        if plan is None:
            shape[6] = _entries(by_surfel, n)
        else:
            shape[6] = plan.room(
                *shape[1:6], items=n, most=MOST_ENTRIES, count=lambda: _entries(by_surfel, n)
            )
            places = plan.places()
        sizes = cuda.kernels("raster_sizes", like)(shape)
        by_entry, scratch = cuda.memory(sizes[1], like), cuda.memory(sizes[3], like)
        planes = like.new_empty(count, camera.height, camera.width)
        moments = like.new_empty(2 if extra == "distortion" else 0, camera.height, camera.width)
        cuda.kernels("raster_draw", like)(
            shape,
            pointers,
            *posed,
            *addresses.each((by_surfel, by_entry, scratch, planes, moments)),
            places,
        )
        ctx.save_for_backward(planes, moments, by_surfel, by_entry, *inputs)
        ctx.set_materialize_grads(False)
        ctx.shape, ctx.posed, ctx.lens = shape, posed, camera.lens
        ctx.pose, ctx.statistics, ctx.absolute = tensors[5], statistics, absolute
        ctx.slot_width = sizes[4]
        none = planes[:0]
        out = []
        for _ in range(SHARES):
            parts = [planes[:channels], planes[padded], planes[channels : channels + 3 * normals]]
            parts += [planes[padded + i] if padded + i < count else none for i in (1, 2, 3)]
            out += [p.permute(1, 2, 0) if p.ndim == 3 else p for p in parts]
        return tuple(out)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        planes, moments, by_surfel, by_entry, *inputs = ctx.saved_tensors
        n, entries, width = ctx.shape[0], ctx.shape[-1], ctx.slot_width
        out = [torch.empty_like(t) for t in inputs]
        v_pose = planes.new_empty(3, 4) if n else planes.new_zeros(3, 4)
        working = [
            planes.new_empty(entries, width),
            cuda.memory(entries, planes),
            planes.new_empty(n, width),
        ]
        parts = planes.new_empty((n + POSE_BLOCK - 1) // POSE_BLOCK, 12)
        wanted = ctx.needs_input_grad[5]
        cuda.kernels("raster_backward", planes)(
            ctx.shape,
            addresses.each(inputs),
            *ctx.posed,
            *addresses.each((by_surfel, by_entry, planes, moments)),
            [addresses.image(v) for v in grads],
            addresses.each((*working, parts if wanted else None)),
            addresses.each((*out, v_pose, ctx.statistics.gradients)),
            ctx.absolute,
        )
        pose = None
        if wanted:
            pose = torch.zeros_like(ctx.pose)
            pose[:3] = v_pose.to(ctx.pose)
        return (*out, pose, *[None] * 6)
