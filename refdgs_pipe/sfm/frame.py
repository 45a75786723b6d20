"""From COLMAP's arbitrary frame to ours: z up, the object on the origin, its ball the unit."""

from dataclasses import replace

import numpy as np

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.sfm.support import Plane


def world_from_sfm(ball: Ball, up: F64, plane: Plane | None, points: F64, front: F64) -> F64:
    """(4, 4) similarity into the world frame of photos.

    Args:
        plane: the support, or None: then the lowest of the points inside the ball stands for it.
        front: (3,) a camera centre; it comes to lie towards -y, the front of a z-up scene.
    """
    inside = points[np.linalg.norm(points - ball.center, axis=1) < ball.radius]
    heights = (inside - ball.center) @ up
    low = float(np.quantile(heights, 0.02)) if len(heights) >= 20 else -ball.radius
    if plane is not None:
        low = -float(plane.heights(ball.center[None])[0])
    foot = ball.center + low * up
    to_front = front - ball.center
    forward = to_front - (to_front @ up) * up
    if np.linalg.norm(forward) < 1e-6 * ball.radius:
        forward = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    y = -forward / np.linalg.norm(forward)
    rotation = np.stack([np.cross(y, up), y, up])
    return similarity(1.0 / ball.radius, rotation, -(rotation @ foot) / ball.radius)


def similarity(scale: float, rotation: F64, translation: F64) -> F64:
    """(4, 4) matrix of x -> scale * rotation @ x + translation."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = scale * rotation, translation
    return out


def moved_camera_pose(cam_from_sfm: F64, world: F64) -> F64:
    """cam_from_world (rigid) of a camera posed in the SfM frame; distances scale with the world."""
    scale = float(np.cbrt(np.linalg.det(world[:3, :3])))
    rotation = world[:3, :3] / scale
    center = -cam_from_sfm[:3, :3].T @ cam_from_sfm[:3, 3]
    pose = np.eye(4)
    pose[:3, :3] = cam_from_sfm[:3, :3] @ rotation.T
    pose[:3, 3] = -pose[:3, :3] @ (world[:3, :3] @ center + world[:3, 3])
    return pose


def turned_up(model: SparseModel) -> SparseModel:
    """The same model, its world turned about the origin so that its up axis becomes z."""
    world = similarity(1.0, z_from_up(model.up), np.zeros(3))
    return moved(model, world)


def z_from_up(up: F64) -> F64:
    """(3, 3) the shortest rotation that turns a unit vector (3,) to +z."""
    target = np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(up, target), float(up @ target)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0.0]])
    if cosine > -1 + 1e-9:
        return np.asarray(np.eye(3) + skew + skew @ skew / (1 + cosine), np.float64)
    return np.diag([1.0, -1.0, -1.0])


def moved(model: SparseModel, world: F64) -> SparseModel:
    """The model in another frame: `world` is the new frame's (4, 4) similarity from the old one."""
    scale = float(np.cbrt(np.linalg.det(world[:3, :3])))

    def at(points: F64) -> F64:
        return np.asarray(points @ world[:3, :3].T + world[:3, 3])

    cameras: tuple[Camera, ...] = tuple(
        replace(camera, cam_from_world=moved_camera_pose(camera.cam_from_world, world))
        for camera in model.cameras
    )
    return replace(
        model,
        cameras=cameras,
        points=at(model.points),
        ball=Ball(at(model.ball.center), model.ball.radius * scale),
        up=world[:3, :3] @ model.up / scale,
        sfm_from_world=model.sfm_from_world @ np.linalg.inv(world),
    )
