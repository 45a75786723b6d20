"""Surfaces that neighbouring photos agree on: depths by a plane sweep, kept where others confirm.

Photos taken from one side have no silhouettes that close round the object. Where it is matte and
textured, neighbouring photos show where its surface is.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.geometry import homography_warp, through_plane
from refdgs_pipe.training.photos import TrainingPhoto, shrunk

F32 = NDArray[np.float32]
Bools = NDArray[np.bool_]

SIDE = 400  # pixels of the longer side
DEPTHS = 96
NEIGHBOURS = 4
ANGLE_DEG = 10.0  # between the directions to a photo and its best neighbour
LEAST_DEG, MOST_DEG = 3.0, 35.0
WINDOW = 7  # pixels
PLAIN = 1e-4  # variance of brightness that tells nothing
BEND, JUMP = 0.1, 0.5  # price of a depth that differs by one from its neighbour's; by more
WORST = 0.5  # 1 - correlation, of a depth that is kept
CONFIRMED = 0.01  # of the depth, by which other photos' depths may differ
CONFIRMING = 2  # photos
FARTHEST = 4.0  # distances of the ball's centre


@dataclass(frozen=True)
class Surface:
    """Points that photos agree on.

    Args:
        points: (N, 3) world; normals: (N, 3) unit, towards the photo.
        colors: (N, 3) sRGB in [0, 1].
        seen: (H, W) bool for each photo, as small as it was compared: where its points come from.
    """

    points: F64
    normals: F64
    colors: F64
    seen: list[Bools]


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The depth that a photo shares with its neighbours.

    Args:
        camera: of the small photo.
        depth: (H, W) along the camera's axis; 0 where there is none.
        good: (H, W) where neighbours find the same.
    """

    camera: Camera
    depth: F32
    good: Bools

    def points(self) -> F64:
        """(H, W, 3) what the pixels show, world."""
        return _places(self.camera, self.depth)


@dataclass(frozen=True)
class _Sight:
    """A photo as it is compared: brightness (H, W) in [0, 1], where it shows anything (H, W)."""

    camera: Camera
    gray: F32
    valid: Bools

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.width, self.camera.height


def agreed_surface(
    model: SparseModel,
    photos: list[TrainingPhoto],
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Surface:
    """Points on what neighbouring photos agree on, in the ball and behind it.

    Each photo is compared with its neighbours at planes of equal depth (Collins 1996), by the
    correlation of small windows; a depth for each pixel follows by semi-global matching
    (Hirschmueller 2008). Depths that two neighbours find as well are kept.

    Args:
        photos: on the CPU.
        threads: photos that are worked on at a time; the result does not depend on it.
        progress: told the photos done and their number; may raise.
    """
    reduced = [small(photo) for photo in photos]
    maps = depth_maps(
        reduced, model.ball.center, lambda camera: _limits(camera, model), threads, progress
    )
    parts, seen = [], []
    for found, photo in zip(maps, reduced, strict=True):
        places, good = found.points(), found.good
        color = photo.rgb.permute(1, 2, 0).numpy()[good] / 255.0
        parts.append((places[good], _normals(places, found.camera)[good], color))
        seen.append(good)
    points, normals, colors = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return Surface(points, normals, colors, seen)


def depth_maps(
    photos: list[TrainingPhoto],
    center: F64,
    limits: Callable[[Camera], tuple[float, float]],
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[DepthMap]:
    """The depths of photos, and where neighbours find the same.

    Args:
        photos: on the CPU, as `small` makes them, or parts of such.
        center: (3,) what the photos show, world; neighbours are chosen by the angle there.
        limits: the nearest and the farthest depth for a photo's camera, world units.
        threads, progress: as for `agreed_surface`.
    """
    sights = [_sight(photo) for photo in photos]
    near = _neighbours([sight.camera for sight in sights], center)
    depths: list[F32] = []

    def depth(i: int) -> F32:
        return _depth(sights[i], [sights[j] for j in near[i]], limits(sights[i].camera))

    with ThreadPoolExecutor(max(1, threads)) as pool:
        for found in pool.map(depth, range(len(sights))):
            depths.append(found)
            if progress is not None:
                progress(len(depths), len(sights))
    maps = []
    for i, sight in enumerate(sights):
        places = _places(sight.camera, depths[i])
        good = _confirmed(places, depths[i] > 0, [(sights[j], depths[j]) for j in near[i]])
        maps.append(DepthMap(sight.camera, depths[i], good))
    return maps


def small(photo: TrainingPhoto) -> TrainingPhoto:
    """The photo as large as it is compared."""
    return shrunk(photo, min(1.0, SIDE / max(photo.camera.width, photo.camera.height)))


def thinned(surface: Surface, which: Bools, count: int) -> tuple[F64, F64, F64]:
    """Points, normals and colours, at most about `count`: means over the cells of a grid.

    Args:
        which: (N,) the points that are wanted.
    """
    points, normals, colors = (
        part[which] for part in (surface.points, surface.normals, surface.colors)
    )
    if not len(points):
        return points, normals, colors
    low, high = 0.0, float(np.ptp(points, axis=0).max()) + 1e-9
    keys, numbers = np.zeros(len(points), np.int64), 0
    for _ in range(20):  # the finest grid that has few enough cells
        size = (low + high) / 2
        cells = np.floor((points - points.min(0)) / size).astype(np.int64)
        flat = np.ravel_multi_index(tuple(cells.T), tuple(cells.max(0) + 1))
        _, found = np.unique(flat, return_inverse=True)
        if found.max() + 1 > count:
            low = size
        else:
            high, keys, numbers = size, found, int(found.max()) + 1
    held = np.bincount(keys, minlength=numbers)[:, None]
    means = []
    for part in (points, normals, colors):
        sums = [np.bincount(keys, part[:, k], minlength=numbers) for k in range(3)]
        means.append(np.stack(sums, -1) / held)
    length = np.linalg.norm(means[1], axis=1, keepdims=True)
    agree = length[:, 0] > 0.3  # not the two sides of something thin
    return means[0][agree], (means[1] / length.clip(1e-9))[agree], means[2][agree]


def _sight(photo: TrainingPhoto) -> _Sight:
    rgb = np.ascontiguousarray(photo.rgb.permute(1, 2, 0).numpy())
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    height, width = gray.shape
    valid = np.ones((height, width), bool) if photo.valid is None else photo.valid.numpy()
    return _Sight(photo.camera, gray, valid)


def _neighbours(cameras: list[Camera], center: F64) -> list[list[int]]:
    """For each photo the others that are best compared with it, by the angle between them."""
    away = np.stack([camera.center for camera in cameras]) - center
    units = away / np.linalg.norm(away, axis=1, keepdims=True).clip(1e-12)
    angles = np.degrees(np.arccos(np.clip(units @ units.T, -1, 1)))
    odd = np.abs(np.log(angles.clip(1e-3) / ANGLE_DEG))
    odd[(angles < LEAST_DEG) | (angles > MOST_DEG)] = np.inf
    order = np.argsort(odd, axis=1, kind="stable")[:, :NEIGHBOURS]
    return [[int(j) for j in row if np.isfinite(odd[i, j])] for i, row in enumerate(order)]


def _limits(camera: Camera, model: SparseModel) -> tuple[float, float]:
    """The nearest and the farthest depth of anything, world units."""
    depth = float(camera.cam_from_world[2, :3] @ model.ball.center + camera.cam_from_world[2, 3])
    reach = 1.05 * model.ball.radius
    near, far = depth - reach, depth + reach
    uv, z = camera.project(model.points)
    shown = (z > 0) & (uv >= 0).all(1) & (uv < (camera.width, camera.height)).all(1)
    if shown.any():
        near = min(near, 0.9 * float(np.quantile(z[shown], 0.02)))
        far = max(far, 1.1 * float(np.quantile(z[shown], 0.9)))
    return max(near, 0.2 * depth), min(far, FARTHEST * depth)


def _depth(one: _Sight, others: list[_Sight], limits: tuple[float, float]) -> F32:
    """(H, W) depths along the camera's axis; 0 where there is none."""
    height, width = one.gray.shape
    near, far = limits
    if not others or not 0 < near < far:
        return np.zeros((height, width), np.float32)
    inverse = np.linspace(1 / far, 1 / near, DEPTHS)
    mean, varies = _moments(one.gray)
    cost = np.empty((DEPTHS, height, width), np.float32)
    for d, depth in enumerate(inverse):
        each = [_unlike(one, mean, varies, other, float(depth)) for other in others]
        cost[d] = np.sort(np.stack(each), 0)[: max(1, len(each) // 2)].mean(0)
    total = np.zeros_like(cost)
    for axis in (1, 2):
        for reverse in (False, True):
            total += _along(cost, axis, reverse=reverse)
    best = total.argmin(0)
    rows, columns = np.mgrid[:height, :width]
    inner = best.clip(1, DEPTHS - 2)
    before, here, after = (total[inner + k, rows, columns] for k in (-1, 0, 1))
    shift = 0.5 * (before - after) / np.maximum(before + after - 2 * here, 1e-6)
    exact = inverse[0] + (inner + shift.clip(-0.5, 0.5)) * (inverse[1] - inverse[0])
    good = (best == inner) & (cost[best, rows, columns] < WORST) & one.valid
    return np.where(good, 1 / exact, 0).astype(np.float32)


def _moments(gray: F32) -> tuple[F32, F32]:
    """(H, W) mean and variance over a window."""
    mean = cv2.blur(gray, (WINDOW, WINDOW))
    return mean, np.maximum(cv2.blur(gray * gray, (WINDOW, WINDOW)) - mean * mean, 0)


def _unlike(one: _Sight, mean: F32, varies: F32, other: _Sight, inverse: float) -> F32:
    """(H, W) 0 to 1: one less the correlation with another photo at a depth of 1 / inverse."""
    to = through_plane(one.camera, other.camera, inverse)
    gray, valid = (
        homography_warp(image, to, *one.size, 0.0)
        for image in (other.gray, other.valid.astype(np.float32))
    )
    mean_2, varies_2 = _moments(gray)
    both = cv2.blur(one.gray * gray, (WINDOW, WINDOW)) - mean * mean_2
    unlike = 1 - both / np.sqrt((varies + PLAIN) * (varies_2 + PLAIN))
    unlike[cv2.blur(valid, (WINDOW, WINDOW)) < 0.999] = 1
    return np.asarray(np.clip(unlike, 0, 1), np.float32)


def _along(cost: F32, axis: int, *, reverse: bool) -> F32:
    """(D, H, W) least price of all depths on the way to each pixel along a row or a column."""
    ways = np.moveaxis(cost, axis, 0)
    ways = ways[::-1] if reverse else ways
    out = np.empty_like(ways)
    out[0] = before = ways[0]
    for place in range(1, len(ways)):
        least = before.min(0)
        best = np.minimum(before, least + JUMP)
        best[1:] = np.minimum(best[1:], before[:-1] + BEND)
        best[:-1] = np.minimum(best[:-1], before[1:] + BEND)
        out[place] = before = ways[place] + best - least
    return np.moveaxis(out[::-1] if reverse else out, 0, axis)


def _places(camera: Camera, depth: F32) -> F64:
    """(H, W, 3) the points at depths, world."""
    points = camera.pixel_rays() * depth[..., None]
    pose = camera.world_from_cam
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _confirmed(places: F64, there: Bools, others: list[tuple[_Sight, F32]]) -> Bools:
    """(H, W) the points whose depth other photos find as well."""
    count = np.zeros(there.shape, np.int64)
    for other, depth in others:
        uv, z = other.camera.project(places.reshape(-1, 3))
        shown = (z > 0) & (uv >= 0).all(1) & (uv < other.size).all(1)
        column, row = np.where(shown[:, None], uv, 0).astype(np.int64).T
        same = shown & (np.abs(depth[row, column] - z) < CONFIRMED * z)
        count += same.reshape(there.shape)
    return np.asarray(there & (count >= CONFIRMING))


def _normals(places: F64, camera: Camera) -> F64:
    """(H, W, 3) unit normals of smoothed points, towards the camera."""
    smooth = uniform_filter(places, (5, 5, 1), mode="nearest")
    normals = np.cross(np.gradient(smooth, axis=1), np.gradient(smooth, axis=0))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True).clip(1e-12)
    away = (normals * (camera.center - places)).sum(-1, keepdims=True) < 0
    return np.where(away, -normals, normals)
