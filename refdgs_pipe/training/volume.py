"""A coarse volume of colour and density fitted to the photos, and the hollows that it shows."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from torch import Tensor
from torch.nn import functional

from refdgs_pipe.camera import F64, Camera

Bool = NDArray[np.bool_]

RAYS = 4096  # a step
SIDES = (0.5, 1.0)  # of the grid, half of the steps each
START_DENSITY = -5.0  # raw: all but empty
SHIFT, GAIN = 3.0, 3.0  # optical thickness of a cell: GAIN * softplus(raw - SHIFT)
RATE_DENSITY, RATE_COLOR = 0.3, 0.15  # of Adam, falling to a tenth
MASK_WEIGHT = 0.01
POINT_WEIGHT = 0.1  # of the agreement of every sample's own colour with its pixel
VARIATION_WEIGHT = 0.02  # of the opacity's total variation
SLACK = 1.0  # cells that the surface must lie behind an empty cell
RESIDUAL = 0.08  # sRGB: a pixel that the volume explains
THROUGH = 15  # photos that must look through an empty cell, at most a sixth of all
FOLDS = 2  # each photo is judged by a volume that was fitted to the others
EXPLAINED = 0.5  # share of these in which the volume explains the pixel


@dataclass(frozen=True)
class _Space:
    """A cubic grid of cells around a centre, in world units.

    Args:
        low: the first cell's centre along each axis from `center`.
        cell: edge length.
        solid: (n, n, n) bool, cells that can hold anything.
        ground: (n, n, n) bool, cells in which a surface explains no photo.
    """

    center: Tensor
    low: float
    cell: float
    solid: Tensor
    ground: Tensor

    @property
    def cells(self) -> int:
        return self.solid.shape[0]

    @property
    def reach(self) -> float:
        """From the centre to beyond the cells' edge."""
        return self.cell - self.low


@dataclass(frozen=True)
class _Rays:
    """Origins and unit directions (N, 3) from the grid's centre, colour over white, mask (N,)."""

    origin: Tensor
    direction: Tensor
    color: Tensor
    mask: Tensor


def hollow_cells(
    hull: Bool,
    ticks: F64,
    center: F64,
    cameras: list[Camera],
    pictures: list[Tensor],
    masks: list[Tensor],
    ground: Bool | None = None,
    *,
    steps: int,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> Bool:
    """(n, n, n) cells of the hull that photos look through, by a volume fitted to them.

    A grid of density and colour (as in direct voxel grid optimisation, Sun et al. 2022, without a
    network and without view dependence) starts all but empty and is fitted for some `steps` of
    random rays. Where most photos that look through a cell are explained by what lies behind, it is
    a hollow. Each photo is judged by a volume that never saw it: a volume can imitate a mirror in
    photos that it learns, but not in others. Mirrors are not explained, and keep their hull.

    Args:
        hull: (n, n, n) cells that can hold anything.
        ticks: (n,) the cells' centres along each axis from `center`, world units.
        pictures: (3, H, W) float sRGB in [0, 1] for each camera, straight.
        masks: (H, W) float in [0, 1] for each camera.
        ground: (n, n, n) cells on the ground and below: a surface there explains no photo, as in
            `empty_cells`.
        progress: told the steps done and their number; may raise to stop.
    """
    solid = torch.from_numpy(binary_dilation(hull))
    middle = torch.tensor(center, dtype=torch.float64)
    below = torch.from_numpy(np.zeros_like(hull) if ground is None else ground)
    space = _Space(middle, float(ticks[0]), float(ticks[1] - ticks[0]), solid, below)
    index = torch.from_numpy(np.argwhere(hull))
    points = middle + space.low + index * space.cell
    through, explained = torch.zeros(2, len(points))
    photos = list(zip(cameras, pictures, masks, strict=True))
    for fold in range(FOLDS):
        learned = [photo for i, photo in enumerate(photos) if i % FOLDS != fold]
        rays = [_rays(*photo, space, margin=True)[0] for photo in learned]
        if not any(len(part.mask) for part in rays):
            return np.zeros_like(hull)
        told = None if progress is None else _later(progress, fold * (steps // FOLDS), steps)
        volume = _fitted(_joined(rays), space, steps // FOLDS, seed + fold, told)
        for camera, picture, mask in photos[fold::FOLDS]:
            passes, good = _looks_through(camera, picture, mask, space, volume, points)
            through += passes
            explained += good
    enough = min(THROUGH, math.ceil(len(cameras) / 6))
    empty = (through >= enough) & (explained >= EXPLAINED * through)
    out = np.zeros_like(hull)
    out[tuple(index[empty].T.numpy())] = True
    return out


def _joined(parts: list[_Rays]) -> _Rays:
    """The rays of several photos as one set."""
    names = ("origin", "direction", "color", "mask")
    return _Rays(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def _later(
    progress: Callable[[int, int], None], begun: int, steps: int
) -> Callable[[int, int], None]:
    """Progress of work that begins after `begun` steps of `steps` were done."""
    return lambda done, _: progress(begun + done, steps)


def _rays(
    camera: Camera, picture: Tensor, mask: Tensor, space: _Space, *, margin: bool
) -> tuple[_Rays, tuple[Tensor, Tensor]]:
    """Rays through the mask's pixels (and two around it), and the pixels' rows and columns."""
    shown = functional.max_pool2d(mask[None, None], 5, 1, 2)[0, 0] if margin else mask
    y, x = torch.nonzero(shown > 0, as_tuple=True)
    K, pose = camera.K, torch.tensor(camera.cam_from_world[:3, :3])
    seen = [(x + 0.5 - K[0, 2]) / K[0, 0], (y + 0.5 - K[1, 2]) / K[1, 1], torch.ones_like(x)]
    direction = torch.stack([s.double() for s in seen], -1) @ pose
    direction = direction / direction.norm(dim=-1, keepdim=True)
    origin = (torch.tensor(camera.center) - space.center).expand(len(x), 3)
    alpha = mask[y, x]
    color = picture[:, y, x].T * alpha[:, None] + (1 - alpha[:, None])
    return _Rays(origin.float(), direction.float(), color, alpha), (y, x)


def _samples(
    rays: _Rays, space: _Space, step: float, jitter: Tensor | float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Distances (N, S), and of samples in solid cells the ray, the place on it, grid point."""
    count = int(2 * space.reach / step)
    middle = -(rays.origin * rays.direction).sum(-1, keepdim=True)
    t = middle - space.reach + (torch.arange(count) + jitter) * step
    points = rays.origin[:, None] + rays.direction[:, None] * t[..., None]
    cells = ((points - space.low) / space.cell).round().long()
    inside = ((cells >= 0) & (cells < space.cells)).all(-1)
    i, j, k = cells.clamp(0, space.cells - 1).unbind(-1)
    ray, place = torch.nonzero(inside & space.solid[i, j, k], as_tuple=True)
    span = space.cell * (space.cells - 1)
    grid = ((points[ray, place] - space.low) / span * 2 - 1).flip(-1)
    return t, ray, place, grid


def _march(
    volume: Tensor, space: _Space, samples: tuple[Tensor, Tensor, Tensor, Tensor], step: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Colour over white (N, 3), alpha (N,), samples' weights and colours, thickness (N, S)."""
    t, ray, place, grid = samples
    values = functional.grid_sample(volume, grid[None, None, None], align_corners=True)[0, :, 0, 0]
    thick = GAIN * functional.softplus(values[0] - SHIFT) * (step / space.cell)
    along = torch.zeros(t.shape).index_put((ray, place), thick)
    passed = torch.cumsum(along, 1)
    weight = torch.exp(along - passed) * (1 - torch.exp(-along))
    own, rgb = weight[ray, place], torch.sigmoid(values[1:].T)
    color = torch.zeros(len(t), 3).index_add(0, ray, own[:, None] * rgb)
    alpha = weight.sum(1)
    return color + (1 - alpha)[:, None], alpha, torch.cat([own[:, None], rgb], 1), passed


def _fitted(
    rays: _Rays,
    space: _Space,
    steps: int,
    seed: int,
    progress: Callable[[int, int], None] | None,
) -> Tensor:
    """(1, 4, n, n, n) raw density and raw colour."""
    random = torch.Generator().manual_seed(seed)
    volume = torch.zeros(1, 4, 2, 2, 2)
    volume[:, 0] = START_DENSITY
    done = 0
    for number, share in enumerate(SIDES, 1):
        n, last = max(2, round(space.cells * share)), steps * number // len(SIDES)
        shape = (n, n, n)
        volume = functional.interpolate(volume, shape, mode="trilinear", align_corners=True)
        density, color = (v.clone().requires_grad_() for v in (volume[:, :1], volume[:, 1:]))
        groups = [{"params": [density]}, {"params": [color]}]
        optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))
        step, begun = 0.75 * space.cell / share, done
        while done < last:
            slow: float = 0.1 ** ((done - begun) / max(1, last - begun))
            for group, rate in zip(optimizer.param_groups, (RATE_DENSITY, RATE_COLOR), strict=True):
                group["lr"] = rate * slow
            pick = torch.randint(len(rays.mask), (RAYS,), generator=random)
            jitter = torch.rand(RAYS, 1, generator=random)
            batch = _Rays(
                rays.origin[pick], rays.direction[pick], rays.color[pick], rays.mask[pick]
            )
            optimizer.zero_grad()
            loss = _loss(torch.cat([density, color], 1), batch, space, step, jitter)
            torch.autograd.backward(loss)
            optimizer.step()
            done += 1
            if progress is not None and done % 10 == 0:
                progress(done, steps)
        volume = torch.cat([density, color], 1).detach()
    return volume


def _loss(volume: Tensor, rays: _Rays, space: _Space, step: float, jitter: Tensor) -> Tensor:
    samples = _samples(rays, space, step, jitter)
    image, alpha, own, _ = _march(volume, space, samples, step)
    loss = (image - rays.color).square().mean()
    covered = alpha.clamp(1e-4, 1 - 1e-4)
    loss = loss + MASK_WEIGHT * functional.binary_cross_entropy(covered, rays.mask)
    apart = (own[:, 1:] - rays.color[samples[1]]).square().mean(1)
    loss = loss + POINT_WEIGHT * (own[:, 0] * apart).sum() / len(rays.mask)
    opacity = 1 - torch.exp(-GAIN * functional.softplus(volume[:, 0] - SHIFT))
    varies = [opacity.diff(dim=axis).abs().mean() for axis in (1, 2, 3)]
    return loss + VARIATION_WEIGHT * torch.stack(varies).sum()


@torch.no_grad()
def _looks_through(
    camera: Camera, picture: Tensor, mask: Tensor, space: _Space, volume: Tensor, points: Tensor
) -> tuple[Tensor, Tensor]:
    """(N,) whether the photo's surface lies behind each point; and is explained there, too."""
    distance = float(np.linalg.norm(camera.center - space.center.numpy()))
    scale = min(1.0, distance / (space.cell * float(camera.K[0, 0])))  # a cell: a pixel
    camera = camera.resized(
        max(8, round(camera.width * scale)), max(8, round(camera.height * scale))
    )
    size = (camera.height, camera.width)
    both = torch.cat([picture, mask[None]])[None]
    small = functional.interpolate(both, size, mode="area")[0]
    rays, (y, x) = _rays(camera, small[:3], small[3], space, margin=False)
    step = 0.5 * space.cell
    samples = _samples(rays, space, step, 0.5)
    image, _, _, passed = _march(volume, space, samples, step)
    pose = torch.tensor(camera.cam_from_world)
    half = math.log(2.0)
    behind = passed > half
    first = samples[0].gather(1, behind.float().argmax(1)[:, None])[:, 0]
    first = torch.where(behind.any(1), first, torch.inf)  # distance of the surface
    places = rays.origin + first.nan_to_num(posinf=0)[:, None] * rays.direction
    i, j, k = (
        ((places - space.low) / space.cell).round().long().clamp(0, space.cells - 1).unbind(-1)
    )
    forward = rays.direction.double() @ pose[2, :3]
    depth, explained = torch.full(size, -1.0), torch.zeros(size)
    depth[y, x] = (first * forward).float()
    good = ((image - rays.color).abs().amax(-1) < RESIDUAL) & ~space.ground[i, j, k]
    explained[y, x] = good.float()
    px, py, z = (points @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    K = camera.K
    column, row = ((px / z * K[0, 0] + K[0, 2]).floor(), (py / z * K[1, 1] + K[1, 2]).floor())
    seen = (z > 0) & (column >= 0) & (row >= 0) & (column < size[1]) & (row < size[0])
    column, row = torch.where(seen, column, 0).long(), torch.where(seen, row, 0).long()
    passes = (seen & (depth[row, column] > z + SLACK * space.cell)).float()
    return passes, passes * explained[row, column]
