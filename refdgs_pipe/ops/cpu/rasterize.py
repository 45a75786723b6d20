"""Drawing surfels on the CPU."""

from typing import Any

import _refdgs_native as native
import torch
from torch import Tensor

from refdgs_pipe.ops import addresses
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

_idle: dict[torch.dtype, list[Any]] = {torch.float32: [], torch.float64: []}


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
    """`ops.rasterize`; inputs are checked there. No list needs a plan."""
    n = len(features)
    statistics = ScreenStatistics(features.new_zeros(n), features.new_zeros(n, 2))
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
        threads,
        absolute,
        needed,
        statistics,
    )
    return maps_of(parts, statistics, extra, normals)


class _Frame:
    """A kernel's working memory, handed back for reuse when the graph lets go of it."""

    def __init__(self, dtype: torch.dtype) -> None:
        make = native.RasterFloat if dtype == torch.float32 else native.RasterDouble
        self.dtype = dtype
        self.raster = _idle[dtype].pop() if _idle[dtype] else make()

    def __del__(self) -> None:
        _idle[self.dtype].append(self.raster)


class Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, ...]:
        *tensors, camera, extra, normals, threads, absolute, needed, statistics = args
        ctx.needed = None if needed is None else needed.contiguous()  # backward reads it too
        inputs = [t.detach().contiguous() for t in tensors[:5]]
        n, channels = inputs[4].shape
        dtype = inputs[0].dtype
        padded, count = planes_of(channels, extra, normals)
        planes = torch.empty(count, camera.height, camera.width, dtype=dtype)
        ctx.frame = _Frame(dtype)
        ctx.frame.raster.forward(
            addresses.each(inputs),
            n,
            channels,
            addresses.pose_and_lens(camera),
            camera.width,
            camera.height,
            EXTRAS[extra],
            normals,
            threads,
            absolute,
            addresses.of(ctx.needed),
            addresses.of(planes),
            addresses.of(statistics.radii),
        )
        ctx.save_for_backward(planes, *inputs)
        ctx.set_materialize_grads(False)
        ctx.pose, ctx.statistics = tensors[5], statistics
        none = planes[:0]
        parts = [planes[:channels], planes[padded], planes[channels : channels + 3 * normals]]
        parts += [planes[padded + i] if padded + i < count else none for i in (1, 2, 3)]
        ctx.places = [p.storage_offset() // planes[0].numel() for p in parts]
        return tuple(p.permute(1, 2, 0) if p.ndim == 3 else p for p in parts)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        planes, *inputs = ctx.saved_tensors
        out = [torch.empty_like(t) for t in inputs]
        v_pose = torch.zeros(3, 4, dtype=planes.dtype)
        kept: list[Tensor] = []  # while their addresses are in use
        v_planes = [0] * len(planes)
        for place, grad in zip(ctx.places, grads, strict=True):
            if grad is None:
                continue
            by_plane = grad.permute(2, 0, 1) if grad.ndim == 3 else grad[None]
            if by_plane.stride()[1:] != (planes.shape[2], 1):
                by_plane = by_plane.contiguous()
            kept.append(by_plane)
            for index, plane in enumerate(by_plane):
                v_planes[place + index] = addresses.of(plane)
        ctx.frame.raster.backward(
            addresses.each(inputs),
            *inputs[4].shape,
            addresses.of(planes),
            v_planes,
            addresses.each((*out, v_pose, ctx.statistics.gradients)),
        )
        pose = None
        if ctx.needs_input_grad[5]:
            pose = torch.zeros_like(ctx.pose)
            pose[:3] = v_pose.to(ctx.pose.dtype)
        return (*out, pose, *[None] * 7)
