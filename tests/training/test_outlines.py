import numpy as np
from scenes import orbit

from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.training.outlines import outline_shifts

RADIUS = 1.0


def ball_masks(cameras: list[Camera]) -> list[np.ndarray]:
    """Hard masks of a ball at the origin."""
    masks = []
    for camera in cameras:
        rays = camera.pixel_rays() @ camera.cam_from_world[:3, :3]
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        miss = np.linalg.norm(np.cross(rays, -camera.center), axis=-1)
        masks.append((miss < RADIUS).astype(np.float32))
    return masks


def directions(count: int) -> F64:
    drawn = np.random.default_rng(0).normal(size=(count, 3))
    unit: F64 = drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    return unit


def test_points_find_the_ball_from_inside_and_from_outside() -> None:
    cameras = orbit(30, size=96, focal=130)
    normals = directions(300)
    radii = np.random.default_rng(1).uniform(0.95, 1.05, 300)
    shifts = outline_shifts(radii[:, None] * normals, normals, 0.1, cameras, ball_masks(cameras), 0)
    pixel = np.linalg.norm(cameras[0].center) / cameras[0].K[0, 0]
    assert np.quantile(np.abs(radii + shifts - RADIUS), 0.9) < 0.5 * pixel


def test_points_far_from_the_outline_stay() -> None:
    cameras = orbit(30, size=96, focal=130)
    normals = directions(50)
    for radius in (0.5, 1.5):
        shifts = outline_shifts(radius * normals, normals, 0.1, cameras, ball_masks(cameras), 0)
        assert not shifts.any()


def test_one_wrong_mask_is_outvoted() -> None:
    cameras = orbit(30, size=96, focal=130)
    normals = directions(100)
    masks = ball_masks(cameras)
    masks[3] = np.zeros_like(masks[3])
    assert not outline_shifts(normals, normals, 0.1, cameras, masks, 0).any()
    shifts = outline_shifts(normals, normals, 0.1, cameras, masks, 1)
    assert np.quantile(np.abs(shifts), 0.9) < 0.05
    assert shifts.any()
