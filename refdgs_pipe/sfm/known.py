"""Poses that came with the capture become a sparse model; nothing is matched."""

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.files.images import read_png
from refdgs_pipe.sfm.ball import carved_ball, focus_point, seen_radius

MASK_SIDE = 200  # px: masks for carving a coarse grid need no more
CARVING_PHOTOS = 40
Z_IS_UP_DEG = 40.0


def model_from_known_poses(views: Views) -> SparseModel:
    """Keep the capture's own world frame; find the ball and the up axis in it."""
    cameras = known_cameras(views)
    lenses = {view.name: view.known.lens for view in views.items if view.known is not None}
    points = views.points
    train = tuple(camera for camera in cameras if camera.split == "train") or cameras
    return SparseModel(
        cameras=cameras,
        lenses=lenses,
        points=np.zeros((0, 3)) if points is None else points.xyz,
        point_colors=np.zeros((0, 3), np.uint8) if points is None else points.colors,
        tracks={} if points is None else points.tracks,
        ball=ball_of(train, views),
        up=known_up(train),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(),
    )


def known_cameras(views: Views) -> tuple[Camera, ...]:
    """Distortion-free cameras of the known poses, by name."""
    cameras = [
        Camera(v.name, v.width, v.height, v.known.lens.K, v.known.cam_from_world, v.split)
        for v in views.items
        if v.known is not None
    ]
    return tuple(sorted(cameras, key=lambda camera: camera.name))


def ball_of(cameras: tuple[Camera, ...], views: Views) -> Ball:
    """The ball around the visual hull where there are masks, else what most photos show whole."""
    center = focus_point(cameras)
    guess = Ball(center, seen_radius(cameras, center))
    masked = tuple(camera for camera in cameras if views[camera.name].mask is not None)
    if len(masked) < 3:
        return guess
    masked = masked[:: -(-len(masked) // CARVING_PHOTOS)]
    carved = carved_ball(masked, [_small_mask(views, camera.name) for camera in masked], guess)
    return carved or guess


def mean_up(cameras: tuple[Camera, ...]) -> F64:
    """(3,) unit mean of the photos' upward directions."""
    up = -np.stack([camera.cam_from_world[1, :3] for camera in cameras]).mean(0)
    return up / max(float(np.linalg.norm(up)), 1e-12)


def known_up(cameras: tuple[Camera, ...]) -> F64:
    """World z if the photos do not contradict it, else their own mean upward direction."""
    up = mean_up(cameras)
    z = np.array([0.0, 0.0, 1.0])
    return z if up[2] > np.cos(np.radians(Z_IS_UP_DEG)) else up


def _small_mask(views: Views, name: str) -> NDArray[np.float32]:
    path = views.mask_path(views[name])
    assert path is not None
    mask = read_png(path)
    scale = MASK_SIDE / max(mask.shape)
    size = (max(1, round(mask.shape[1] * scale)), max(1, round(mask.shape[0] * scale)))
    small = cv2.resize(mask, size, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32) / np.float32(255)
