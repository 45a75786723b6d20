"""The ball that the object lives in, from cameras and masks."""

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.errors import PoseError
from refdgs_pipe.files.images import read_png

F32 = NDArray[np.float32]

GRID = 64  # cells along an edge of the carved cube
MASK_SIDE = 200  # px: masks for carving a coarse grid need no more
CARVING_PHOTOS = 40
GROWTH = 1.6
CROWDED_RIM = 0.85  # radii; 0.6 was measured where the ball fits, 1.0 where it was too small
MARGIN = 1.03  # the soft rim of masks, and the cells' size


def object_ball(cameras: tuple[Camera, ...], views: Views) -> Ball:
    """The ball around the visual hull where there are masks, else what most photos show whole.

    Raises:
        PoseError: half of the cameras do not look at one common point.
    """
    center = focus_point(cameras)
    guess = Ball(center, seen_radius(cameras, center))
    if not guess.radius > 0:
        raise PoseError(
            f"fewer than half of the {len(cameras)} cameras see the point that they look at "
            "together, so there is no telling where the object is. Either the photos were placed "
            "wrongly (take more of them, overlapping, with textured surroundings) or they look "
            "outwards (walk around the object and keep it in the middle)"
        )
    return masked_ball(cameras, views, guess)


def masked_ball(cameras: tuple[Camera, ...], views: Views, guess: Ball) -> Ball:
    """The ball around the visual hull of the views' masks; the guess, where they show none."""
    masked = tuple(camera for camera in cameras if views[camera.name].mask is not None)
    if len(masked) < 3:
        return guess
    masked = masked[:: -(-len(masked) // CARVING_PHOTOS)]
    carved = carved_ball(masked, [_small_mask(views, camera.name) for camera in masked], guess)
    return carved or guess


def grown_ball(ball: Ball, solid: F64, *, one_sided: bool = False) -> Ball:
    """The ball, enlarged if the points that are on no wall or table lie at its rim and around it.

    What most photos show whole is too small where photos are narrow or close: at most 1.6 times.

    Args:
        solid: (n, 3) points on no large plane, near the ball.
        one_sided: photos show one side of something that may go on beyond the pictures: the ball
            holds nearly all points near it.
    """
    near = solid[np.linalg.norm(solid - ball.center, axis=1) < GROWTH * ball.radius]
    if one_sided and len(near) >= 100:
        reach = float(np.quantile(np.linalg.norm(near - ball.center, axis=1), 0.95))
        return Ball(ball.center, float(np.clip(MARGIN * reach, ball.radius, GROWTH * ball.radius)))
    middle = np.median(np.linalg.norm(near - ball.center, axis=1)) if len(near) >= 100 else 0.0
    if middle < CROWDED_RIM * ball.radius:
        return ball
    center = (ball.center + np.median(near, axis=0)) / 2
    reach = float(np.quantile(np.linalg.norm(near - center, axis=1), 0.95))
    return Ball(center, float(np.clip(reach, ball.radius, GROWTH * ball.radius)))


def focus_point(cameras: tuple[Camera, ...]) -> F64:
    """(3,) the point nearest to all optical axes, cameras that look elsewhere weighted down."""
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.cam_from_world[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # projectors onto the axes' normals
    weights = np.ones(len(cameras))
    point = centers.mean(0)
    for _ in range(20):
        total = np.einsum("n,nij->ij", weights, across) + 1e-9 * np.eye(3)
        point = np.linalg.solve(total, np.einsum("n,nij,nj->i", weights, across, centers))
        misses = np.linalg.norm(np.einsum("nij,nj->ni", across, point - centers), axis=1)
        weights = 1.0 / np.maximum(misses, 0.1 * np.median(misses) + 1e-9)
    return np.asarray(point, np.float64)


def seen_radius(cameras: tuple[Camera, ...], center: F64, *, share: float = 0.5) -> float:
    """Radius of the largest ball around `center` that this share of the photos shows whole."""
    radii = []
    for camera in cameras:
        x, y, z = camera.cam_from_world[:3, :3] @ center + camera.cam_from_world[:3, 3]
        (fx, _, cx), (_, fy, cy) = camera.K[:2]
        sides = (
            (fx * x + cx * z) / np.hypot(fx, cx),
            ((camera.width - cx) * z - fx * x) / np.hypot(fx, camera.width - cx),
            (fy * y + cy * z) / np.hypot(fy, cy),
            ((camera.height - cy) * z - fy * y) / np.hypot(fy, camera.height - cy),
        )
        radii.append(max(0.0, min(sides)))
    return float(np.quantile(radii, 1 - share))


def carved_ball(cameras: tuple[Camera, ...], masks: list[F32], guess: Ball) -> Ball | None:
    """The ball around the visual hull, or None if the masks leave nothing.

    Args:
        masks: for each camera (h, w) at any scale, in [0, 1].
        guess: where to look; the cube searched is 1.6 times as large.
    """
    center, half = guess.center, 1.6 * guess.radius
    kept = np.zeros((0, 3))
    for _ in range(2):
        cells = _grid(center, half)
        kept = cells[_inside_hull(cells, half / GRID, cameras, masks)]
        if len(kept) < 4:
            return None
        low, high = kept.min(0), kept.max(0)
        cell = 2 * half / GRID
        center, half = (low + high) / 2, float((high - low).max()) / 2 + 2 * cell
    ball = enclosing_ball(kept)
    return Ball(ball.center, (ball.radius + cell * 0.87) * MARGIN)


def enclosing_ball(points: F64) -> Ball:
    """Nearly the smallest ball around points (Badoiu and Clarkson 2003)."""
    center = points.mean(0)
    for i in range(1, 400):
        farthest = points[np.argmax(((points - center) ** 2).sum(1))]
        center = center + (farthest - center) / (i + 1)
    return Ball(center, float(np.sqrt(((points - center) ** 2).sum(1).max())))


def _grid(center: F64, half: float) -> F64:
    ticks = (np.arange(GRID) + 0.5) / GRID * 2 - 1
    return center + half * np.stack(np.meshgrid(ticks, ticks, ticks), -1).reshape(-1, 3)


def _inside_hull(
    cells: F64, radius: float, cameras: tuple[Camera, ...], masks: list[F32]
) -> NDArray[np.bool_]:
    """Cells that four in five photos show, and all of these but one in thirty see as object.

    Cells that few photos show would survive unjudged below and above the object.
    """
    seen = np.zeros(len(cells), np.int32)
    hits = np.zeros(len(cells), np.int32)
    for camera, mask in zip(cameras, masks, strict=True):
        small = camera.resized(mask.shape[1], mask.shape[0])
        uv, depth = small.project(cells)
        grow = int(np.ceil(radius * small.K[0, 0] / max(float(np.median(depth)), 1e-6)))
        kernel = np.ones((2 * grow + 1, 2 * grow + 1), np.uint8)
        grown = cv2.dilate((mask > 0.25).astype(np.uint8), kernel) > 0
        shown = (depth > 0) & (uv >= 0).all(1) & (uv < (small.width, small.height)).all(1)
        column, row = uv[shown].astype(np.int64).T
        seen += shown
        hits[shown] += grown[row, column]
    return (seen >= 0.8 * len(cameras)) & (hits >= seen - np.maximum(1, seen // 30))


def _small_mask(views: Views, name: str) -> NDArray[np.float32]:
    path = views.mask_path(views[name])
    assert path is not None
    mask = read_png(path)
    scale = MASK_SIDE / max(mask.shape)
    size = (max(1, round(mask.shape[1] * scale)), max(1, round(mask.shape[0] * scale)))
    small = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32) / np.float32(255)
