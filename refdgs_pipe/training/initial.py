"""Where surfels start: in the visual hull of the masks, at sparse points, or in the ball."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_fill_holes, uniform_filter
from scipy.spatial import KDTree
from torch import Tensor

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.training.carving import boundary, empty_cells, needed_by_masks
from refdgs_pipe.training.ground import Surroundings
from refdgs_pipe.training.outlines import outline_shifts
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.settings import StartParams
from refdgs_pipe.training.volume import hollow_cells

F32 = NDArray[np.float32]

HULL_CELLS = 96  # along the ball's diameter
GROUND_CELLS = 1.5  # above the ground, whose own thickness comes on top
SKY_SURFELS = 4000
SKY_DISTANCE = 8.0  # of the farthest camera from the ball, in their distance


@dataclass(frozen=True)
class Cloud:
    """Discs to start from: points (N, 3), unit normals (N, 3), sizes (N,), colors (N, 3) sRGB."""

    points: F64
    normals: F64
    sizes: F64
    colors: F64


@dataclass(frozen=True)
class Hull:
    """The visual hull as cells (n, n, n) with centres at ticks (n,) from the ball's centre."""

    cells: NDArray[np.bool_]
    ticks: F64
    ball: Ball

    @property
    def cell(self) -> float:
        return float(self.ticks[1] - self.ticks[0])

    def axes(self) -> tuple[F64, F64, F64]:
        """World coordinates of the cells' centres along x, y and z."""
        x, y, z = (self.ball.center[axis] + self.ticks for axis in range(3))
        return x, y, z

    def heights(self, up: F64) -> F64:
        """(n, n, n) heights of the cells' centres along a unit direction (3,), world units."""
        x, y, z = np.meshgrid(*self.axes(), indexing="ij")
        return np.asarray(x * up[0] + y * up[1] + z * up[2])

    def cells_at(self, points: F64) -> NDArray[np.int64]:
        """(N, 3) the cells in which points (N, 3) lie, world; outside of the grid if they do."""
        places = (points - self.ball.center - self.ticks[0]) / self.cell
        return np.asarray(np.rint(places), np.int64)

    def on_ground(self, around: Surroundings) -> NDArray[np.bool_]:
        """(n, n, n) cells on the ground, below it, and up to GROUND_CELLS above it."""
        x, y, z = np.meshgrid(*self.axes(), indexing="ij")
        points = np.stack([x, y, z], -1).reshape(-1, 3)
        if around.up is not None:
            points = points - GROUND_CELLS * self.cell * around.up
        return ~around.above(torch.from_numpy(points)).numpy().reshape(self.cells.shape)


def hull_ticks(ball: Ball, n: int) -> F64:
    """(n,) the centres of a hull's cells along each axis, from the ball's centre."""
    return np.asarray(((np.arange(n) + 0.5) / n * 2 - 1) * ball.radius * 1.05)


def visual_hull(ball: Ball, cameras: list[Camera], masks: list[F32]) -> Hull | None:
    """Cells that (nearly) all masks cover, or None if the masks leave nothing.

    Args:
        masks: (H, W) in [0, 1] for each camera, at its size.
    """
    n = HULL_CELLS
    ticks = hull_ticks(ball, n)
    alive = np.arange(n**3)
    misses = np.zeros(n**3, np.int16)
    allowed = _doubters(cameras)
    for camera, mask in zip(cameras, masks, strict=True):
        i, j, k = alive // (n * n), alive // n % n, alive % n
        points = ball.center + np.stack([ticks[i], ticks[j], ticks[k]], -1)
        uv, depth = camera.project(points)
        inside = (depth > 0) & (uv >= 0).all(1) & (uv < (camera.width, camera.height)).all(1)
        col, row = np.where(inside[:, None], uv, 0).astype(np.int64).T
        misses[alive] += inside & (mask[row, col] < 0.25)
        alive = alive[misses[alive] <= allowed]
    if len(alive) < 50:
        return None
    cells = np.zeros(n**3, bool)
    cells[alive] = True
    return Hull(cells.reshape(n, n, n), ticks, ball)


def carved(
    hull: Hull,
    cameras: list[Camera],
    pictures: list[Tensor],
    masks: list[Tensor],
    *,
    around: Surroundings | None = None,
    volume_steps: int = 0,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Hull:
    """The hull without the hollows that the photos (3, H, W) show.

    They are found by `empty_cells` and, with `volume_steps`, by `hollow_cells`. What the masks need
    comes back, and what no hollow reaches is filled.

    Args:
        around: knows the ground; what photos seem to see on it, within the masks, is mirrored.
    """
    ground = None if around is None else hull.on_ground(around)
    left = hull.cells & ~empty_cells(hull.cells, hull.axes(), cameras, pictures, masks, ground)
    kept, known = (uniform_filter(c.astype(np.float32), 3) for c in (left, hull.cells))
    left = hull.cells & (kept >= 0.5 * known)  # a majority of the neighbours in the hull: no crumbs
    if volume_steps:
        left &= ~hollow_cells(
            hull.cells,
            hull.ticks,
            hull.ball.center,
            cameras,
            pictures,
            masks,
            ground,
            steps=volume_steps,
            seed=seed,
            progress=progress,
        )
    left |= needed_by_masks(hull.cells, left, hull.axes(), cameras, masks)
    left = hull.cells & binary_fill_holes(left)
    return replace(hull, cells=left) if left.sum() >= 50 else hull


def closed_hull(model: SparseModel, photos: list[TrainingPhoto]) -> Hull | None:
    """The visual hull of the photos' masks, or None if those have nothing in common."""
    covers = [mask.numpy() for mask in _masks(photos)]
    return visual_hull(model.ball, [photo.camera for photo in photos], covers)


def object_hull(
    p: StartParams,
    model: SparseModel,
    photos: list[TrainingPhoto],
    progress: Callable[[int, int], None] | None = None,
    *,
    closed: Hull | None = None,
) -> Hull | None:
    """The solid within the photos' masks, or None if those have nothing in common.

    Args:
        closed: of `closed_hull`, if it is known.
        progress: told the steps done and their number; may raise.
    """
    hull = closed or closed_hull(model, photos)
    if hull is None or p.masked != "carved":
        return hull
    return carved(
        hull,
        [photo.camera for photo in photos],
        [photo.rgb.float() / 255 for photo in photos],
        _masks(photos),
        around=Surroundings(model, ground=True),
        volume_steps=p.volume_steps,
        seed=p.seed,
        progress=progress,
    )


def hull_cloud(
    p: StartParams, hull: Hull, photos: list[TrainingPhoto], rng: np.random.Generator
) -> Cloud:
    """Where surfels start on a solid, or in it (`masked` "volume")."""
    if p.masked == "volume":
        return volume_cloud(hull, p.surfels, rng)
    cameras, covers = [photo.camera for photo in photos], [m.numpy() for m in _masks(photos)]
    return surface_cloud(hull, p.surfels, rng, cameras, covers, p.outline_cells)


def _masks(photos: list[TrainingPhoto]) -> list[Tensor]:
    """(H, W) in [0, 1] of each photo that has one."""
    return [photo.mask.float() / 255 for photo in photos if photo.mask is not None]


def volume_cloud(hull: Hull, count: int, rng: np.random.Generator) -> Cloud:
    """Discs throughout the hull, turned at random."""
    found = np.argwhere(hull.cells)
    picked = found[rng.choice(len(found), count, replace=len(found) < count)]
    points = hull.ball.center + hull.ticks[picked] + hull.cell * (rng.random((count, 3)) - 0.5)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(points, normals, neighbour_sizes(points), np.full((count, 3), 0.3))


def surface_cloud(
    hull: Hull,
    count: int,
    rng: np.random.Generator,
    cameras: list[Camera],
    masks: list[F32],
    reach: float = 0.0,
) -> Cloud:
    """Discs on the hull's boundary, oriented by its smoothed gradient.

    Args:
        reach: those with an outline of the masks as near as that, in cells, move there.
    """
    shell = np.argwhere(boundary(hull.cells))
    smooth = hull.cells.astype(np.float32)
    for axis in range(3):
        smooth = _blurred(smooth, axis)
    gradient = np.stack([np.gradient(smooth, axis=axis) for axis in range(3)], -1)
    picked = shell[rng.choice(len(shell), count, replace=len(shell) < count)]
    normals = -gradient[tuple(picked.T)].astype(np.float64)
    normals += 1e-6 * rng.normal(size=normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = hull.ball.center + hull.ticks[picked] + hull.cell * (rng.random(picked.shape) - 0.5)
    if reach > 0:
        far = reach * hull.cell
        shifts = outline_shifts(points, normals, far, cameras, masks, _doubters(cameras))
        points += shifts[:, None] * normals
    area = len(shell) * hull.cell**2 * 1.2
    sizes = np.full(count, math.sqrt(area / count) * 0.6)
    return Cloud(points, normals, sizes, np.full((count, 3), 0.3))


def _doubters(cameras: list[Camera]) -> int:
    """How many masks may deny what the others cover."""
    return max(1, len(cameras) // 30)


def _blurred(values: F32, axis: int) -> F32:
    """A 5-tap binomial blur along one axis."""
    out = np.float32(6) * values
    for shift, weight in ((1, 4), (2, 1)):
        out = out + weight * (np.roll(values, shift, axis) + np.roll(values, -shift, axis))
    return np.asarray(out / 16, np.float32)


def ball_cloud(ball: Ball, count: int, rng: np.random.Generator, *, share: float = 1.0) -> Cloud:
    """Random discs in (a share of) the ball."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = ball.center + direction * ball.radius * share * rng.random((count, 1)) ** (1 / 3)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(points, normals, neighbour_sizes(points), np.full((count, 3), 0.3))


def sparse_cloud(
    points: F64, colors: NDArray[np.uint8], cameras: list[Camera], rng: np.random.Generator
) -> Cloud:
    """Discs at sparse points, facing the cameras roughly."""
    centers = np.stack([camera.center for camera in cameras])
    towards = centers[rng.integers(len(centers), size=len(points))] - points
    normals = towards / np.linalg.norm(towards, axis=1, keepdims=True).clip(1e-9)
    normals += 0.2 * rng.normal(size=normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(points, normals, neighbour_sizes(points), colors / 255.0)


def sky_cloud(ball: Ball, cameras: list[Camera], color: F64) -> Cloud:
    """A far sphere of discs that face inwards, for whatever has no sparse points."""
    distance = max(float(np.linalg.norm(c.center - ball.center)) for c in cameras)
    radius = SKY_DISTANCE * max(distance, ball.radius)
    i = np.arange(SKY_SURFELS) + 0.5
    z, phi = 1 - 2 * i / SKY_SURFELS, i * math.pi * (1 + 5**0.5)
    flat = np.sqrt(1 - z * z)
    direction = np.stack([flat * np.cos(phi), flat * np.sin(phi), z], -1)
    sizes = np.full(SKY_SURFELS, radius * math.sqrt(4 * math.pi / SKY_SURFELS) * 0.7)
    colors = np.broadcast_to(color, direction.shape)
    return Cloud(ball.center + radius * direction, -direction, sizes, colors)


def joined(*clouds: Cloud) -> Cloud:
    """All discs in one cloud."""
    return Cloud(
        *(
            np.concatenate([getattr(c, name) for c in clouds])
            for name in ("points", "normals", "sizes", "colors")
        )
    )


def chosen(cloud: Cloud, which: NDArray[np.bool_]) -> Cloud:
    """Some of the discs."""
    return Cloud(*(getattr(cloud, n)[which] for n in ("points", "normals", "sizes", "colors")))


def neighbour_sizes(points: F64) -> F64:
    """(N,) 0.5 of the root mean squared distance to the three nearest neighbours."""
    if len(points) < 4:
        return np.full(len(points), 0.01)
    tree = KDTree(points)
    distances, _ = tree.query(points, k=4)
    sizes = 0.5 * np.sqrt(np.maximum((distances[:, 1:] ** 2).mean(1), 1e-14))
    return np.asarray(np.minimum(sizes, 8 * np.median(sizes)), np.float64)


def raw_discs(cloud: Cloud, opacity: float) -> dict[str, Tensor]:
    """The geometry of a trainable set: means, quats, log_scales, raw_opacities."""
    return {
        "means": torch.tensor(cloud.points, dtype=torch.float32),
        "quats": torch.tensor(_quats_of(cloud.normals), dtype=torch.float32),
        "log_scales": torch.tensor(np.log(cloud.sizes), dtype=torch.float32)[:, None].repeat(1, 2),
        "raw_opacities": torch.full((len(cloud.points),), math.log(opacity / (1 - opacity))),
    }


def _quats_of(normals: F64) -> F64:
    """(N, 4) shortest rotations that take z to the normals."""
    x, y, z = normals.T
    quats = np.stack([1 + z, -y, x, np.zeros_like(z)], -1)
    quats[z < -0.9999] = (0, 1, 0, 0)
    return np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True))
