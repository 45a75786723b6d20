"""Drawing surfels."""

from collections.abc import Callable

import torch
from torch import Tensor

from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops import cuda
from refdgs_pipe.ops.cpu import rasterize as on_cpu
from refdgs_pipe.ops.definition import rasterize as definition
from refdgs_pipe.ops.gpu import rasterize as on_gpu
from refdgs_pipe.ops.plan import Plan
from refdgs_pipe.ops.registry import Operation, backend_of
from refdgs_pipe.ops.scene import Extra, Maps, Pinhole, Surfels

MAX_CHANNELS = 20

_RASTERIZE = Operation("rasterize", definition.rasterize, on_cpu.rasterize, on_gpu.rasterize)


def rasterize(
    surfels: Surfels,
    features: Tensor,
    camera: Pinhole,
    *,
    extra: Extra = "none",
    normals: bool = False,
    needed: Tensor | Callable[[], Tensor] | None = None,
    absolute: bool = True,
    threads: int | None = None,
    plan: Plan | None = None,
) -> Maps:
    """Render surfels and their features, front to back (2D Gaussian Splatting, Huang et al. 2024).

    The ray is intersected with each disc; a screen-space Gaussian of sigma 1/sqrt(8) pixels (2DGS:
    1/sqrt(2)) around the projected centre keeps small and edge-on discs visible. Contributions
    below 1/255 are skipped and a pixel stops before its transmittance falls below 1e-4; these
    decisions and the sorting by centre depth carry no gradient. Everything else does, to every
    input including the camera's pose.

    Args:
        features: (N, C) what to blend; C <= 20, or 17 with normals.
        extra: which of the depth maps to make.
        needed: (H, W) bool, pixels that will be looked at, or a function that makes them; None for
            all. What the maps hold elsewhere is not defined, and a gradient from there counts for
            nothing: the CPU leaves these pixels empty; a GPU draws them and does not call the
            function.
        absolute: false: `ScreenStatistics` goes without the second of its gradients, which the CPU
            then leaves 0, for speed.
        threads: default torch's; of the CPU.
        plan: room for the tiles' lists on a GPU, which then nothing waits for.

    Raises:
        ShapeError: sizes or types that must agree do not.
        DeviceError: the tensors are on a device that this build has no kernels for.
    """
    _check(surfels, features, camera, normals)
    if callable(needed):
        needed = None if backend_of(surfels.means) == "gpu" else needed()
    if needed is not None and (needed.dtype, tuple(needed.shape)) != (
        torch.bool,
        (camera.height, camera.width),
    ):
        raise ShapeError(
            f"needed is {tuple(needed.shape)} of {needed.dtype}: give {camera.height} rows of "
            f"{camera.width} torch.bool"
        )
    count = threads or torch.get_num_threads()
    maps: Maps = _RASTERIZE.kernel(surfels.means)(
        surfels, features, camera, extra, normals, needed, absolute, count, plan
    )
    return maps


def _check(surfels: Surfels, features: Tensor, camera: Pinhole, normals: bool) -> None:
    n = surfels.means.shape[0]
    wanted: dict[str, tuple[Tensor, Callable[[tuple[int, ...]], bool], str]] = {
        "means": (surfels.means, lambda s: s == (n, 3), "(N, 3)"),
        "quats": (surfels.quats, lambda s: s == (n, 4), "(N, 4)"),
        "scales": (surfels.scales, lambda s: s == (n, 2), "(N, 2)"),
        "opacities": (surfels.opacities, lambda s: s == (n,), "(N,)"),
        "features": (features, lambda s: len(s) == 2 and s[0] == n, "(N, C)"),
    }
    for name, (tensor, fits, shape) in wanted.items():
        if not fits(tuple(tensor.shape)):
            raise ShapeError(
                f"{name} is {tuple(tensor.shape)}, but means has N = {n}: give {shape}"
            )
        if tensor.dtype != surfels.means.dtype or tensor.device != surfels.means.device:
            raise ShapeError(
                f"{name} is {tensor.dtype} on {tensor.device}, means is {surfels.means.dtype} on "
                f"{surfels.means.device}: give all in one type on one device"
            )
    if surfels.means.dtype not in (torch.float32, torch.float64):
        raise ShapeError(f"means is {surfels.means.dtype}: give float32 (or float64 for proofs)")
    cuda.check_gpu("means", surfels.means)
    channels = features.shape[1] + (3 if normals else 0)
    if not 0 < channels <= MAX_CHANNELS:
        raise ShapeError(f"{channels} channels with normals; at most {MAX_CHANNELS} are possible")
    if camera.width < 1 or camera.height < 1 or max(camera.width, camera.height) > 32000:
        raise ShapeError(f"image of {camera.width}x{camera.height}: give 1 to 32000 pixels a side")
