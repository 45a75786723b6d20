"""Drawing surfels: the public function, its checks and its choice of backend."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import ShapeError
from refdgs_pipe.ops import cuda
from refdgs_pipe.ops.plan import Plan

Extra = Literal["none", "depth", "distortion"]
EXTRAS = {"none": 0, "depth": 1, "distortion": 2}  # as the native functions number them
MAX_CHANNELS = 20


@dataclass(frozen=True)
class Surfels:
    """2-D Gaussians on discs.

    Args:
        means: (N, 3) centres, world units.
        quats: (N, 4) w, x, y, z; normalised by the rasteriser.
        scales: (N, 2) standard deviations along the disc's axes, world units.
        opacities: (N,) in (0, 1).
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor


@dataclass(frozen=True)
class Pinhole:
    """A camera as the rasteriser takes it.

    Args:
        cam_from_world: (3 or 4, 4) tensor; may require a gradient (pose refinement).
        fx, fy, cx, cy: pixels; pixel centres are at +0.5.
        near: depth before which nothing is drawn, world units.
        lens: (19,) on a GPU, in the surfels' type: the pose's rows, fx, fy, cx, cy and the camera's
            centre. Where it is given, kernels read these instead, so that recorded work can be
            given another camera of the same size and `near`.
    """

    cam_from_world: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = 1e-3
    lens: Tensor | None = None

    @classmethod
    def of(
        cls, camera: Camera, near: float = 1e-3, *, dtype: torch.dtype = torch.float32
    ) -> "Pinhole":
        K = camera.K
        if abs(K[0, 1]) > 1e-6 * K[0, 0]:
            raise ShapeError(f"camera {camera.name} has skew {K[0, 1]}: pixels must be rectangular")
        pose = torch.from_numpy(np.ascontiguousarray(camera.cam_from_world)).to(dtype)
        fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        return cls(pose, fx, fy, cx, cy, camera.width, camera.height, near)

    @property
    def center(self) -> Tensor:
        """(3,) where it is in the world: on the GPU with a `lens`, else where the pose is."""
        if self.lens is not None:
            return self.lens[-3:]
        pose = self.cam_from_world
        return -pose[:3, :3].T @ pose[:3, 3]

    def numbers(self) -> list[float]:
        """What `lens` holds."""
        pose: list[float] = self.cam_from_world[:3].detach().flatten().tolist()
        center: list[float] = replace(self, lens=None).center.tolist()
        return [*pose, self.fx, self.fy, self.cx, self.cy, *center]


@dataclass
class ScreenStatistics:
    """What densification wants to know of each surfel.

    Args:
        radii: (N,) pixels; 0 where the surfel was not drawn.
        gradients: (N, 2), filled by the backward pass: the length of the summed gradient of the
            loss with respect to the projected centre, and that of the sum of its per-pixel
            absolute values (AbsGS); loss per pixel of displacement.
    """

    radii: Tensor
    gradients: Tensor


@dataclass(frozen=True)
class Maps:
    """Blended front to back; `w` is a surfel's share of the pixel.

    Args:
        features: (H, W, C) sum of w f.
        alpha: (H, W) sum of w.
        normal: (H, W, 3) sum of w n, world space, each n facing the camera; None if not asked for.
        depth: (H, W) sum of w z; median_depth: (H, W) z where the transmittance passes 1/2,
            else 0; None if not asked for.
        distortion: (H, W) sum over pairs of w_i w_j (m_i - m_j)^2 with m = near / z.
    """

    features: Tensor
    alpha: Tensor
    normal: Tensor | None
    depth: Tensor | None
    median_depth: Tensor | None
    distortion: Tensor | None
    statistics: ScreenStatistics = field(repr=False)


def maps_of(
    parts: tuple[Tensor, ...], statistics: ScreenStatistics, extra: Extra, normals: bool
) -> Maps:
    """From features, alpha, normal, depth, median and distortion; those not asked for are None."""
    blended, alpha, normal, depth, median, distortion = parts
    return Maps(
        features=blended,
        alpha=alpha,
        normal=normal if normals else None,
        depth=depth if extra != "none" else None,
        median_depth=median if extra != "none" else None,
        distortion=distortion if extra == "distortion" else None,
        statistics=statistics,
    )


def planes_of(channels: int, extra: Extra, normals: bool) -> tuple[int, int]:
    """Number of constant channels (padded to 4) and of all planes in the kernel's output."""
    padded = (channels + (3 if normals else 0) + 3) // 4 * 4
    return padded, padded + {"none": 1, "depth": 3, "distortion": 4}[extra]


def rasterize(
    surfels: Surfels,
    features: Tensor,
    camera: Pinhole,
    *,
    extra: Extra = "none",
    normals: bool = False,
    needed: Tensor | None = None,
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
        needed: (H, W) bool, pixels that will be looked at, or None for all. What the maps hold
            elsewhere is not defined, and a gradient from there counts for nothing: the CPU leaves
            these pixels empty, a GPU draws them.
        absolute: false: `ScreenStatistics` goes without the second of its gradients, which the CPU
            then leaves 0, for speed.
        threads: default torch's; of the CPU.
        plan: room for the tiles' lists on a GPU, which then nothing waits for.

    Raises:
        ShapeError: sizes or types that must agree do not.
        DeviceError: the tensors are on a device that this build has no kernels for.
    """
    _check(surfels, features, camera, normals)
    if needed is not None and (needed.dtype, tuple(needed.shape)) != (
        torch.bool,
        (camera.height, camera.width),
    ):
        raise ShapeError(
            f"needed is {tuple(needed.shape)} of {needed.dtype}: give {camera.height} rows of "
            f"{camera.width} torch.bool"
        )
    if cuda.on_gpu(surfels.means):
        from refdgs_pipe.ops import cuda_rasterize

        return cuda_rasterize.draw(surfels, features, camera, extra, normals, plan)
    from refdgs_pipe.ops.native import draw

    count = threads or torch.get_num_threads()
    return draw(surfels, features, camera, extra, normals, count, absolute, needed)


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
