"""Poses that came with the capture become a sparse model; nothing is matched."""

import numpy as np

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.sfm.ball import object_ball
from refdgs_pipe.sfm.support import level_up

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
        ball=object_ball(train, views),
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


def known_up(cameras: tuple[Camera, ...]) -> F64:
    """World z if the photos do not contradict it, else their own mean upward direction."""
    up = level_up(cameras)
    z = np.array([0.0, 0.0, 1.0])
    return z if up[2] > np.cos(np.radians(Z_IS_UP_DEG)) else up
