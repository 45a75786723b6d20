"""A coarse volume of colour and density fitted to the photos, and the hollows that it shows."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter
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
BETTER = 0.2  # correlation with the pattern there, above that of the closed hull
CONTRAST = 0.06  # of that pattern, sRGB: what is plain matches whatever lies behind
PATTERN = 7  # pixels, as large as cells, over which patterns are compared
BROAD = (
    4.0  # cells (sigma) over which the pattern is averaged: what is plain goes with its surround
)
FAINT = 0.02  # contrast that tells nothing
OPAQUE = 20.0  # raw density of the closed hull


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
    a hollow, if the volume also shows the photo's pattern round there, and better than the closed
    hull with one colour for each place does. Each photo is judged by a volume that never saw it: a
    volume can imitate a mirror in photos that it learns, but not in others. Mirrors are not
    explained, and keep their hull. Plain surfaces tell nothing: they go with what is round them.

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
    told = torch.zeros(4, len(points))
    photos = list(zip(cameras, pictures, masks, strict=True))
    for fold in range(FOLDS):
        learned = [photo for i, photo in enumerate(photos) if i % FOLDS != fold]
        rays = [_rays(*photo, space, margin=True)[0] for photo in learned]
        if not any(len(part.mask) for part in rays):
            return np.zeros_like(hull)
        later = None if progress is None else _later(progress, fold * (steps // FOLDS), steps)
        volume = _fitted(_joined(rays), space, steps // FOLDS, seed + fold, later)
        shut = _shut(hull, space, learned)
        for photo in photos[fold::FOLDS]:
            told += _looks_through(_Seen.of(*photo, space), space, volume, shut, points)
    through, explained = told[:2]
    better, contrast = _around(told, index, hull.shape)
    enough = min(THROUGH, math.ceil(len(cameras) / 6))
    empty = (through >= enough) & (explained >= EXPLAINED * through)
    empty &= (better >= BETTER) & (contrast >= CONTRAST)
    out = np.zeros_like(hull)
    out[tuple(index[empty].T.numpy())] = True
    return out


def _around(told: Tensor, index: Tensor, shape: tuple[int, ...]) -> Tensor:
    """(2, N) the mean of the last two figures over the photos through the cells round each cell.

    Args:
        told: (4, N) sums over photos, as `_looks_through` gives them; index: (N, 3) of the cells.
    """
    grid = np.zeros((4, *shape), np.float32)
    places = tuple(index.T.numpy())
    grid[(slice(None), *places)] = told.numpy()
    photos, *sums = (gaussian_filter(grid[k], BROAD)[places] for k in (0, 2, 3))
    return torch.from_numpy(np.stack(sums) / np.maximum(photos, 1e-6))


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


@dataclass(frozen=True)
class _Seen:
    """A photo at a size at which a cell is about a pixel.

    Args:
        rays: through its mask; rows, columns: (N,) of their pixels.
    """

    camera: Camera
    rays: _Rays
    rows: Tensor
    columns: Tensor

    @classmethod
    def of(cls, camera: Camera, picture: Tensor, mask: Tensor, space: _Space) -> "_Seen":
        distance = float(np.linalg.norm(camera.center - space.center.numpy()))
        scale = min(1.0, distance / (space.cell * float(camera.K[0, 0])))
        camera = camera.resized(
            max(8, round(camera.width * scale)), max(8, round(camera.height * scale))
        )
        both = torch.cat([picture, mask[None]])[None]
        size = (camera.height, camera.width)
        small = functional.interpolate(both, size, mode="area")[0]
        rays, (y, x) = _rays(camera, small[:3], small[3], space, margin=False)
        return cls(camera, rays, y, x)

    def picture(self, values: Tensor, fill: float) -> Tensor:
        """(H, W) or (3, H, W) of values (N,) or (N, 3) at the rays' pixels."""
        size = (self.camera.height, self.camera.width)
        out = torch.full((*values.shape[1:], *size), fill)
        out[..., self.rows, self.columns] = values.movedim(0, -1)
        return out

    def first(self, space: _Space, volume: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
        """Colours (N, 3), distances (N,) of the surface, inf for none, and its cells (N,) each."""
        samples = _samples(self.rays, space, 0.5 * space.cell, 0.5)
        image, _, _, passed = _march(volume, space, samples, 0.5 * space.cell)
        behind = passed > math.log(2.0)
        first = samples[0].gather(1, behind.float().argmax(1)[:, None])[:, 0]
        first = torch.where(behind.any(1), first, torch.inf)
        places = self.rays.origin + first.nan_to_num(posinf=0)[:, None] * self.rays.direction
        cells = ((places - space.low) / space.cell).round().long().clamp(0, space.cells - 1)
        return image, first, cells.unbind(-1)


@dataclass(frozen=True)
class _Shut:
    """The simpler explanation: what photos see lies on the hull, with one colour for all photos.

    Args:
        volume: (1, 4, n, n, n) the hull without hollows, as from `_fitted`; without colours.
        colors: (n, n, n, 3) sRGB, the mean of what photos see on its surface.
    """

    volume: Tensor
    colors: Tensor


@torch.no_grad()
def _shut(hull: Bool, space: _Space, photos: list[tuple[Camera, Tensor, Tensor]]) -> _Shut:
    """The hull closed, with the colours that these photos see on it."""
    volume = torch.zeros(1, 4, *hull.shape)
    volume[0, 0] = torch.where(torch.from_numpy(hull), OPAQUE, START_DENSITY)
    color, count = torch.zeros(*hull.shape, 3), torch.zeros(hull.shape)
    for photo in photos:
        seen = _Seen.of(*photo, space)
        _, first, cells = seen.first(space, volume)
        there = torch.isfinite(first)
        index = tuple(part[there] for part in cells)
        color.index_put_(index, seen.rays.color[there], accumulate=True)
        count.index_put_(index, torch.ones(int(there.sum())), accumulate=True)
    near = [functional.avg_pool3d(v[None], 3, 1, 1)[0] for v in (color.movedim(-1, 0), count[None])]
    return _Shut(volume, (near[0] / near[1].clamp(min=1e-6)).movedim(0, -1))


@torch.no_grad()
def _looks_through(
    seen: _Seen, space: _Space, volume: Tensor, shut: _Shut, points: Tensor
) -> Tensor:
    """(4, N) of each point: whether the photo's surface lies behind it, and if so, whether the
    volume explains the pixel, how much better its pattern fits than the closed hull's, and the
    contrast of the photo's pattern.
    """
    image, first, cells = seen.first(space, volume)
    _, _, places = seen.first(space, shut.volume)
    pose, rays = torch.tensor(seen.camera.cam_from_world), seen.rays
    forward = rays.direction.double() @ pose[2, :3]
    depth = seen.picture((first * forward).float(), -1.0)
    good = ((image - rays.color).abs().amax(-1) < RESIDUAL) & ~space.ground[cells]
    own, opened, closed = (
        _pattern(seen.picture(c, 1.0)) for c in (rays.color, image, shut.colors[places])
    )
    better = _likeness(own, opened) - _likeness(own, closed)
    px, py, z = (points @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    K, (height, width) = seen.camera.K, depth.shape
    column, row = ((px / z * K[0, 0] + K[0, 2]).floor(), (py / z * K[1, 1] + K[1, 2]).floor())
    inside = (z > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    column, row = torch.where(inside, column, 0).long(), torch.where(inside, row, 0).long()
    passes = (inside & (depth[row, column] > z + SLACK * space.cell)).float()
    explained, contrast = seen.picture(good.float(), 0.0), _mean((own * own).sum(0)).sqrt()
    figures = torch.stack([torch.ones_like(depth), explained, better, contrast])
    found: Tensor = passes * figures[:, row, column]
    return found


def _mean(image: Tensor) -> Tensor:
    """(H, W) mean over the window in which patterns are compared."""
    return functional.avg_pool2d(image[None, None], PATTERN, 1, PATTERN // 2)[0, 0]


def _pattern(image: Tensor) -> Tensor:
    """(3, H, W) without the mean around each pixel."""
    return image - torch.stack([_mean(channel) for channel in image])


def _likeness(one: Tensor, other: Tensor) -> Tensor:
    """(H, W) correlation of two patterns (3, H, W); 0 where there is none."""
    both, a, b = (_mean(product.sum(0)) for product in (one * other, one * one, other * other))
    return both / torch.sqrt((a + FAINT**2) * (b + FAINT**2))
