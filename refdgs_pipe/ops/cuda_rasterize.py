"""Drawing surfels on a GPU, behind autograd."""

from typing import Any

import torch
from torch import Tensor

from refdgs_pipe.ops import addresses, cuda
from refdgs_pipe.ops.plan import Plan
from refdgs_pipe.ops.rasterize import (
    EXTRAS,
    Extra,
    Maps,
    Pinhole,
    ScreenStatistics,
    Surfels,
    maps_of,
    planes_of,
)

GRAD_HEAD = 12  # of a slot, before its channels
MOST_ENTRIES = 2**31 - 1
POSE_BLOCK = 128  # surfels whose pose gradients are added first


def draw(
    surfels: Surfels,
    features: Tensor,
    camera: Pinhole,
    extra: Extra,
    normals: bool,
    plan: Plan | None,
) -> Maps:
    """Rasterise on the GPU; inputs are checked by `rasterize`."""
    n = len(features)
    statistics = ScreenStatistics(features.new_zeros(n), features.new_zeros(n, 2))
    parts = _Rasterize.apply(  # type: ignore[no-untyped-call]
        surfels.means,
        surfels.quats,
        surfels.scales,
        surfels.opacities,
        features,
        camera.cam_from_world,
        camera,
        extra,
        normals,
        plan,
        statistics,
    )
    return maps_of(parts, statistics, extra, normals)


def _numbers(camera: Pinhole) -> list[float]:
    """The pose's rows and the lens. A pose on the GPU would be waited for: keep it on the CPU."""
    pose: list[float] = camera.cam_from_world[:3].detach().double().flatten().tolist()
    return [*pose, camera.fx, camera.fy, camera.cx, camera.cy, camera.near]


def _entries(by_surfel: Tensor, n: int) -> int:
    """How many entries the tiles' lists have. A drawing without a plan waits for it."""
    return int(by_surfel[8 * n : 8 * n + 8].view(torch.int64))


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, ...]:
        *tensors, camera, extra, normals, plan, statistics = args
        inputs = [t.detach().contiguous() for t in tensors[:5]]
        like = inputs[0]
        n, channels = inputs[4].shape
        padded, count = planes_of(channels, extra, normals)
        shape = [n, channels, camera.width, camera.height, EXTRAS[extra], int(normals), 0]
        pointers = [t.data_ptr() for t in inputs]
        posed = (_numbers(camera), addresses.lens(camera))

        sizes = cuda.kernels("raster_sizes", like)(shape)
        by_surfel, scratch = cuda.memory(sizes[0], like), cuda.memory(sizes[2], like)
        cuda.kernels("raster_project", like)(
            shape,
            pointers,
            *posed,
            by_surfel.data_ptr(),
            statistics.radii.data_ptr(),
            scratch.data_ptr(),
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
            by_surfel.data_ptr(),
            by_entry.data_ptr(),
            scratch.data_ptr(),
            planes.data_ptr(),
            moments.data_ptr(),
            places,
        )
        ctx.save_for_backward(planes, moments, by_surfel, by_entry, *inputs)
        ctx.set_materialize_grads(False)
        ctx.shape, ctx.posed, ctx.lens = shape, posed, camera.lens
        ctx.pose, ctx.statistics = tensors[5], statistics
        none = planes[:0]
        parts = [planes[:channels], planes[padded], planes[channels : channels + 3 * normals]]
        parts += [planes[padded + i] if padded + i < count else none for i in (1, 2, 3)]
        return tuple(p.permute(1, 2, 0) if p.ndim == 3 else p for p in parts)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        planes, moments, by_surfel, by_entry, *inputs = ctx.saved_tensors
        n, channels, *_, normals, entries = ctx.shape
        width = GRAD_HEAD + (channels + 3 * normals + 3) // 4 * 4
        out = [torch.empty_like(t) for t in inputs]
        v_pose = planes.new_zeros(3, 4)
        working = [
            planes.new_empty(entries, width),
            cuda.memory(entries, planes),
            planes.new_empty(n, width),
        ]
        parts = planes.new_empty((n + POSE_BLOCK - 1) // POSE_BLOCK, 12)
        wanted = ctx.needs_input_grad[5]
        cuda.kernels("raster_backward", planes)(
            ctx.shape,
            [t.data_ptr() for t in inputs],
            *ctx.posed,
            by_surfel.data_ptr(),
            by_entry.data_ptr(),
            planes.data_ptr(),
            moments.data_ptr(),
            [addresses.image(v) for v in grads],
            [*(t.data_ptr() for t in working), parts.data_ptr() if wanted else 0],
            [t.data_ptr() for t in (*out, v_pose, ctx.statistics.gradients)],
        )
        pose = None
        if wanted:
            pose = torch.zeros_like(ctx.pose)
            pose[:3] = v_pose.to(ctx.pose)
        return (*out, pose, *[None] * 5)
