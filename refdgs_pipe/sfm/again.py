"""Each photo's place found again from what only the other photos see: a cross-validation.

A reconstruction bends its points to the photos that hold them. So the points that a photo sees are
triangulated from the other photos alone, the photo is placed by them once more, and how far its
place moves tells how well the others determine it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64

LEAST_ANGLE = np.radians(1.5)  # between the other photos' rays to a point
LEAST_POINTS = 6  # that place a photo
ROUNDS = 15
OUTLIER_PX = 2.0  # misses beyond this weigh less (Huber)


@dataclass(frozen=True)
class Sights:
    """Which photo sees which point where. One row for each sight.

    Args:
        photo, point: (n,) numbers.
        ray: (n, 2) x / z and y / z in the photo's camera, without distortion.
    """

    photo: NDArray[np.int64]
    point: NDArray[np.int64]
    ray: F64


def moves(cam_from_world: F64, points: F64, sights: Sights, pixel: F64) -> F64:
    """How far each photo's place moves when the other photos alone give its points.

    Points come from the rays' nearest place in the least squares sense, weighted by distance;
    places from Gauss-Newton steps on the misses in the picture with Huber's weights.

    Args:
        cam_from_world: (k, 4, 4); points: (P, 3); pixel: (k,) size of a pixel at z = 1.

    Returns:
        (k,) shift of the centre as a share of the median distance to the points; infinite where
        the other photos do not give enough points.
    """
    R, t = cam_from_world[:, :3, :3], cam_from_world[:, :3, 3]
    centers = -np.einsum("kji,kj->ki", R, t)
    rays = np.concatenate([sights.ray, np.ones((len(sights.ray), 1))], 1)
    lines = np.einsum("nji,nj->ni", R[sights.photo], rays)
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    away = np.linalg.norm(points[sights.point] - centers[sights.photo], axis=1)
    weight = 1 / np.maximum(away, 1e-12) ** 2
    across = weight[:, None, None] * (np.eye(3) - lines[:, :, None] * lines[:, None, :])
    onto = np.einsum("nij,nj->ni", across, centers[sights.photo])
    A, b, w = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3)), np.zeros(len(points))
    np.add.at(A, sights.point, across)
    np.add.at(b, sights.point, onto)
    np.add.at(w, sights.point, weight)
    found = np.full(len(cam_from_world), np.inf)
    for k in range(len(found)):
        mine = np.flatnonzero(sights.photo == k)
        rest = A[sights.point[mine]] - across[mine]
        total = w[sights.point[mine]] - weight[mine]
        flat = np.linalg.eigvalsh(rest)[:, 0] if len(mine) else np.zeros(0)
        good = flat > total * (1 - np.cos(LEAST_ANGLE)) / 2
        if good.sum() < LEAST_POINTS:
            continue
        mine, rest = mine[good], rest[good]
        others = np.linalg.solve(rest, (b[sights.point[mine]] - onto[mine])[:, :, None])[:, :, 0]
        pose = _placed(cam_from_world[k], others, sights.ray[mine], OUTLIER_PX * pixel[k])
        center = -pose[:3, :3].T @ pose[:3, 3]
        found[k] = np.linalg.norm(center - centers[k]) / np.median(away[mine])
    return found


def _placed(cam_from_world: F64, points: F64, ray: F64, outlier: float) -> F64:
    """(4, 4) the pose from which these points are seen along these rays, from a first guess."""
    pose = cam_from_world.copy()
    damping, best = 1e-3, np.inf
    trial = pose
    for _ in range(ROUNDS):
        x = points @ trial[:3, :3].T + trial[:3, 3]
        depth = np.maximum(x[:, 2], 1e-6)
        miss = x[:, :2] / depth[:, None] - ray
        size = np.linalg.norm(miss, axis=1)
        cost = np.where(size < outlier, size**2 / 2, outlier * (size - outlier / 2)).sum()
        if cost < best:
            best, pose, damping = cost, trial, damping / 4
            weight = np.minimum(1.0, outlier / np.maximum(size, 1e-12))
            J = np.zeros((len(x), 2, 6))  # left perturbation: turn, then shift
            inv = 1 / depth
            J[:, 0, 3] = J[:, 1, 4] = inv
            J[:, 0, 5], J[:, 1, 5] = -x[:, 0] * inv**2, -x[:, 1] * inv**2
            J[:, :, :3] = -np.einsum("nij,njk->nik", J[:, :, 3:], _cross(x))
            H = np.einsum("nij,n,nik->jk", J, weight, J)
            g = np.einsum("nij,n,ni->j", J, weight, miss)
        else:
            damping *= 10
        step = -np.linalg.solve(H + damping * np.diag(np.diag(H)) + 1e-12 * np.eye(6), g)
        trial = _moved(pose, step)
    return pose


def _cross(x: F64) -> F64:
    """(n, 3, 3) matrices with `_cross(x) @ v = x x v`."""
    zero = np.zeros(len(x))
    rows = [zero, -x[:, 2], x[:, 1], x[:, 2], zero, -x[:, 0], -x[:, 1], x[:, 0], zero]
    return np.stack(rows, 1).reshape(-1, 3, 3)


def _moved(pose: F64, step: F64) -> F64:
    import cv2

    out = np.eye(4)
    turn = cv2.Rodrigues(step[:3])[0]
    out[:3, :3] = turn @ pose[:3, :3]
    out[:3, 3] = turn @ pose[:3, 3] + step[3:]
    return out
