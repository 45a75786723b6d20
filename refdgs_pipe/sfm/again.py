"""Each photo's place found again from what only the other photos see: a cross-validation.

A reconstruction bends its points to the photos that hold them. So the points that a photo sees are
triangulated from the other photos alone, the photo is placed by them once more, and how far its
place moves tells how well the others determine it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64

FARTHEST_RAY = 1e3  # x / z, beyond which a lens gone astray gave it
LEAST_ANGLE = np.radians(1.5)  # between the other photos' rays to a point
LEAST_POINTS = 6  # that place a photo
OUTLIER_PX = 2.0  # misses beyond this weigh less (Huber)
NEAREST = 0.01  # of the median depth: a trial place does not come nearer to a point


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

    A point lies where the rays of the other photos come nearest to each other in the least squares
    sense, each weighted by the inverse square of its length. A photo's place minimises the misses
    in its picture under Huber's loss.

    Args:
        cam_from_world: (k, 4, 4); points: (P, 3), any unit of length.
        sights: the points that each photo sees.
        pixel: (k,) size of a pixel in the image at z = 1.

    Returns:
        (k,) shift of the centre as a share of the median distance to the points; infinite where
        the other photos give too few points, or put most of them behind the camera.
    """
    sights = _finite(cam_from_world, points, sights)
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
        mine, rest = mine[good], rest[good]
        others = np.linalg.solve(rest, (b[sights.point[mine]] - onto[mine])[:, :, None])[:, :, 0]
        before = others @ R[k, 2] + t[k, 2] > 0
        if before.sum() < max(LEAST_POINTS, len(mine) / 2):
            continue
        mine, others = mine[before], others[before]
        pose = _placed(cam_from_world[k], others, sights.ray[mine], OUTLIER_PX * pixel[k])
        center = -pose[:3, :3].T @ pose[:3, 3]
        found[k] = np.linalg.norm(center - centers[k]) / np.median(away[mine])
    return found


def _finite(cam_from_world: F64, points: F64, sights: Sights) -> Sights:
    """The sights without those that a mapper or a lens gone astray left without a number."""
    good = (np.abs(sights.ray) < FARTHEST_RAY).all(1) & np.isfinite(points[sights.point]).all(1)
    whole = np.asarray(np.isfinite(cam_from_world).all(axis=(1, 2)))
    good &= whole[sights.photo]
    return Sights(sights.photo[good], sights.point[good], sights.ray[good])


def _placed(cam_from_world: F64, points: F64, ray: F64, outlier: float) -> F64:
    """(4, 4) the pose from which these points are seen along these rays, from a first guess.

    Args:
        outlier: misses beyond this, in units of the image at z = 1, weigh less.
    """
    import cv2
    from scipy.optimize import least_squares

    there = points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    nearest = NEAREST * float(np.median(there[:, 2]))

    def moved(step: F64) -> F64:
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = cv2.Rodrigues(step[:3])[0], step[3:]
        return out

    def misses(step: F64) -> F64:
        x = there @ moved(step)[:3, :3].T + step[3:]
        return np.asarray((x[:, :2] / np.maximum(x[:, 2:], nearest) - ray).ravel())

    found = least_squares(misses, np.zeros(6), loss="huber", f_scale=outlier, x_scale="jac")
    return np.asarray(moved(found.x) @ cam_from_world)
