"""What the operations draw, and what they draw it into."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import ShapeError

Extra = Literal["none", "depth", "distortion"]
EXTRAS = {"none": 0, "depth": 1, "distortion": 2}  # as the native functions number them


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
    others: tuple["Maps", ...] = field(default=(), repr=False)

    def share(self, k: int) -> "Maps":
        """The same maps, k = 0 to 3, for one of several users.

        A GPU adds the gradients of a map's shares as it reads them. Those of two users of one share
        would be added before, in a pass over the image.
        """
        return self.others[k - 1] if 0 < k <= len(self.others) else self


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
