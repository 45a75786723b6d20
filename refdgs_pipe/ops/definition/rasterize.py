"""Drawing surfels in plain torch."""

import torch
from torch import Tensor

from refdgs_pipe.ops.plan import Plan
from refdgs_pipe.ops.scene import Extra, Maps, Pinhole, ScreenStatistics, Surfels

MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
HIT_RADIUS2 = 12.0
MIN_DETERMINANT = 1e-7
LOW_PASS = 8.0


def rotation_matrices(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotations of (N, 4) quaternions w, x, y, z, which are normalised first."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def rasterize(
    surfels: Surfels,
    features: Tensor,
    camera: Pinhole,
    extra: Extra,
    normals: bool,
    needed: Tensor | None = None,
    absolute: bool = False,
    threads: int = 1,
    plan: Plan | None = None,
) -> Maps:
    """Every surfel against every pixel, by the homography of 2DGS (Huang et al. 2024, eq. 8-10).

    `ops.rasterize` without the screen's statistics; all pixels are drawn; memory grows with N H W.
    """
    R, t = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    axes = rotation_matrices(surfels.quats)
    centers = surfels.means @ R.T + t
    tangents = (R @ axes[:, :, :2]) * surfels.scales[:, None, :]
    order = torch.argsort(centers[:, 2].detach(), stable=True)
    visible = (centers[order, 2] > camera.near) & (surfels.opacities[order] > MIN_ALPHA)
    order = order[visible]
    P, U, V = centers[order], tangents[order, :, 0], tangents[order, :, 1]
    opacity = surfels.opacities[order]
    facing = torch.where(((axes[order, :, 2] @ R.T) * P).sum(-1) > 0, -1.0, 1.0)
    normal = axes[order, :, 2] * facing[:, None]

    x = torch.arange(camera.width, dtype=P.dtype) + 0.5
    y = torch.arange(camera.height, dtype=P.dtype) + 0.5
    xy = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    u, v, z, rho2 = _intersect(P, U, V, xy, camera)
    rho3 = u * u + v * v
    rho = torch.where(rho3 <= rho2, rho3, rho2)
    z = torch.where(rho3 <= HIT_RADIUS2, z, P[:, 2:])
    alpha = (opacity[:, None] * torch.exp(-0.5 * rho)).clamp(max=MAX_ALPHA)
    alpha = torch.where((alpha >= MIN_ALPHA) & (z > camera.near), alpha, 0.0)
    after = torch.cumprod(1 - alpha, 0)
    alive = torch.cumprod((after >= MIN_TRANSMITTANCE).to(alpha.dtype), 0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    w = alpha * before * alive

    def image(weighted: Tensor) -> Tensor:
        return weighted.sum(0).reshape(camera.height, camera.width, *weighted.shape[2:])

    crossing = (before > 0.5) & (after <= 0.5) & (alive > 0) & (alpha > 0)
    m = camera.near / z
    pairs = torch.einsum("ip,jp,ijp->p", w, w, (m[:, None] - m[None]) ** 2) / 2
    return Maps(
        features=image(w[..., None] * features[order][:, None]),
        alpha=image(w),
        normal=image(w[..., None] * normal[:, None]) if normals else None,
        depth=image(w * z) if extra != "none" else None,
        median_depth=image(torch.where(crossing, z, 0.0)) if extra != "none" else None,
        distortion=pairs.reshape(camera.height, camera.width) if extra == "distortion" else None,
        statistics=ScreenStatistics(features.new_zeros(len(features)), features.new_zeros(0, 2)),
    )


def _intersect(
    P: Tensor, U: Tensor, V: Tensor, xy: Tensor, camera: Pinhole
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Disc coordinates u, v and depth of each ray's hit, low-pass radius^2; all (N, pixels)."""
    K = torch.tensor(
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=P.dtype
    )
    H = K @ torch.stack([U, V, P], -1)
    center = (P @ K.T)[:, :2] / P[:, 2:]
    offset = xy[None] - center[:, None]
    # rows of the homography with the origin moved to the projected centre
    tx, ty, tw = H[:, 0] - center[:, :1] * H[:, 2], H[:, 1] - center[:, 1:] * H[:, 2], H[:, 2]
    k = offset[..., :1] * tw[:, None] - tx[:, None]
    l = offset[..., 1:] * tw[:, None] - ty[:, None]
    c = torch.linalg.cross(k, l)
    det = tx[:, 0] * ty[:, 1] - tx[:, 1] * ty[:, 0]
    least = MIN_DETERMINANT * (tx[:, :2] ** 2 + ty[:, :2] ** 2).sum(-1)
    floor = torch.where(det < 0, -least, least)
    shift = torch.where(det.abs() < least, floor - det, 0.0)
    q = 1 + (c[..., 2] - det[:, None]) / (det + shift)[:, None]
    behind = q <= 1e-9
    safe = torch.where(behind, 1.0, q)
    scale = (det + shift)[:, None] * safe
    u = torch.where(behind, 1e6, c[..., 0] / scale)
    v = torch.where(behind, 1e6, c[..., 1] / scale)
    return u, v, P[:, 2:] / safe, LOW_PASS * (offset**2).sum(-1)
