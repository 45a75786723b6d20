"""The compiled kernels behind autograd. The only module that hands out tensor addresses."""

from typing import Any

import _refdgs_native as native
import torch
from torch import Tensor

from refdgs_pipe.ops.rasterize import Extra, Maps, Pinhole, ScreenStatistics, Surfels, planes_of

_EXTRA = {"none": 0, "depth": 1, "distortion": 2}
_idle: dict[torch.dtype, list[Any]] = {torch.float32: [], torch.float64: []}


def isa() -> str:
    """The instruction set in use: avx512, avx2 or baseline."""
    return str(native.isa())


def keep_freed_memory() -> None:
    """Tell the allocator to reuse what is freed instead of returning it; for long training runs."""
    native.keep_freed_memory()


def draw(
    surfels: Surfels,
    features: Tensor,
    camera: Pinhole,
    extra: Extra,
    normals: bool,
    threads: int,
) -> Maps:
    """Rasterise on the CPU; inputs are checked by `rasterize`."""
    n, channels = features.shape
    statistics = ScreenStatistics(features.new_zeros(n), features.new_zeros(n, 2))
    planes: Tensor = _Rasterize.apply(  # type: ignore[no-untyped-call]
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
        statistics,
    )
    padded, _ = planes_of(channels, extra, normals)
    images = planes.permute(1, 2, 0)
    return Maps(
        features=images[..., :channels],
        alpha=planes[padded],
        normal=images[..., channels : channels + 3] if normals else None,
        depth=planes[padded + 1] if extra != "none" else None,
        median_depth=planes[padded + 2] if extra != "none" else None,
        distortion=planes[padded + 3] if extra == "distortion" else None,
        statistics=statistics,
    )


class _Frame:
    """A kernel's working memory, handed back for reuse when the graph lets go of it."""

    def __init__(self, dtype: torch.dtype) -> None:
        make = native.RasterFloat if dtype == torch.float32 else native.RasterDouble
        self.dtype = dtype
        self.raster = _idle[dtype].pop() if _idle[dtype] else make()

    def __del__(self) -> None:
        _idle[self.dtype].append(self.raster)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *args: Any) -> Tensor:
        *tensors, camera, extra, normals, threads, statistics = args
        inputs = [t.detach().contiguous() for t in tensors[:5]]
        n, channels = inputs[4].shape
        dtype = inputs[0].dtype
        _, count = planes_of(channels, extra, normals)
        planes = torch.empty(count, camera.height, camera.width, dtype=dtype)
        numbers = [*tensors[5][:3].detach().double().flatten().tolist()]
        numbers += [camera.fx, camera.fy, camera.cx, camera.cy, camera.near]
        ctx.frame = _Frame(dtype)
        ctx.frame.raster.forward(
            [t.data_ptr() for t in inputs],
            n,
            channels,
            numbers,
            camera.width,
            camera.height,
            _EXTRA[extra],
            normals,
            threads,
            planes.data_ptr(),
            statistics.radii.data_ptr(),
        )
        ctx.save_for_backward(planes, *inputs)
        ctx.pose, ctx.statistics = tensors[5], statistics
        return planes

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        planes, *inputs = ctx.saved_tensors
        out = [torch.empty_like(t) for t in inputs]
        v_pose = torch.zeros(3, 4, dtype=planes.dtype)
        v_planes = grads[0].contiguous()
        ctx.frame.raster.backward(
            [t.data_ptr() for t in inputs],
            *inputs[4].shape,
            planes.data_ptr(),
            v_planes.data_ptr(),
            [t.data_ptr() for t in (*out, v_pose, ctx.statistics.gradients)],
        )
        pose = None
        if ctx.needs_input_grad[5]:
            pose = torch.zeros_like(ctx.pose)
            pose[:3] = v_pose.to(ctx.pose.dtype)
        return (*out, pose, None, None, None, None, None)
