"""Which way is up, and the plane that the object stands on."""

from dataclasses import dataclass

import numpy as np

from refdgs_pipe.camera import F64, Camera

TRIALS = 2000
TOLERANCE = 0.01  # thickness of the plane either side, in ball radii
NEAR = 2.5  # points farther from the ball's centre do not vote, in ball radii
PLANES = 3  # walls and tables that can stand around an object
PLANE_SHARE = 0.15  # of the points near by, that a plane must hold to be a wall or a table
TILT_DEG = 25.0  # the support may lean so far against the photos' own idea of up


@dataclass(frozen=True)
class Plane:
    """Points x with normal . x = offset; the normal is unit and points up.

    Args:
        support: how many sparse points lie on it.
    """

    normal: F64
    offset: float
    support: int

    @property
    def at(self) -> tuple[F64, float]:
        """The normal and the offset."""
        return self.normal, self.offset

    def heights(self, points: F64) -> F64:
        """(N,) signed distances of (N, 3) points."""
        return np.asarray(points @ self.normal - self.offset)


def mean_up(cameras: tuple[Camera, ...]) -> F64:
    """(3,) unit mean of the photos' upward directions."""
    return _unit(-np.stack([camera.cam_from_world[1, :3] for camera in cameras]).mean(0))


def level_up(cameras: tuple[Camera, ...]) -> F64:
    """(3,) the direction that is level in all photos, if they agree on one, else their mean up.

    A camera that looks down leans its up vector, but its horizontal axis stays level: where it
    was not rolled, up is what is perpendicular to all horizontal axes.
    """
    mean = mean_up(cameras)
    axes = np.stack([camera.cam_from_world[0, :3] for camera in cameras])
    _, values, directions = np.linalg.svd(axes, full_matrices=True)
    rms = values / np.sqrt(len(cameras))
    if len(values) < 3 or rms[2] > 0.2 or rms[1] < 3 * rms[2]:
        return mean
    level = directions[2] * np.sign(directions[2] @ mean)
    return level if level @ mean > 0.5 else mean


def support_plane(points: F64, center: F64, radius: float, up: F64) -> Plane | None:
    """The plane below the ball's centre that holds most points, roughly level; None without one.

    Args:
        points: (P, 3) sparse points; center, radius: a first guess of the object ball.
    """
    near = points[np.linalg.norm(points - center, axis=1) < NEAR * radius]
    if len(near) < 30:
        return None
    rng = np.random.default_rng(0)
    best: Plane | None = None
    for _ in range(TRIALS):
        a, b, c = near[rng.integers(0, len(near), 3)]
        plane = _plane_through(np.cross(b - a, c - a), a, near, up, TOLERANCE * radius)
        if plane is None or not -0.3 * radius < plane.heights(center[None])[0] < 1.5 * radius:
            continue
        if best is None or plane.support > best.support:
            best = plane
    if best is None or best.support < max(30, PLANE_SHARE * len(near)):
        return None
    on = near[np.abs(best.heights(near)) < TOLERANCE * radius]
    _, _, directions = np.linalg.svd(on - on.mean(0), full_matrices=False)
    return _plane_through(directions[2], on.mean(0), near, up, TOLERANCE * radius) or best


def off_planes(points: F64, center: F64, radius: float) -> F64:
    """(n, 3) the points near by that lie on no large plane: not the table, not a wall.

    Args:
        points: (P, 3) sparse points; center, radius: a first guess of the object ball.
    """
    left = points[np.linalg.norm(points - center, axis=1) < NEAR * radius]
    rng = np.random.default_rng(0)
    for _ in range(PLANES):
        if len(left) < 30:
            break
        corners = left[rng.integers(0, len(left), (TRIALS, 3))]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        corners, normals = corners[lengths > 0], normals[lengths > 0] / lengths[lengths > 0, None]
        offsets = (normals * corners[:, 0]).sum(1)
        sample = left[rng.integers(0, len(left), min(len(left), 1000))]
        close = np.abs(sample @ normals.T - offsets) < TOLERANCE * radius
        best = int(close.sum(0).argmax())
        if close[:, best].mean() < PLANE_SHARE:
            break
        left = left[np.abs(left @ normals[best] - offsets[best]) > 4 * TOLERANCE * radius]
    return np.asarray(left, np.float64)


def _plane_through(normal: F64, point: F64, near: F64, up: F64, tolerance: float) -> Plane | None:
    length = float(np.linalg.norm(normal))
    if length < 1e-12:
        return None
    normal = normal / length * (1.0 if normal @ up >= 0 else -1.0)
    if normal @ up < np.cos(np.radians(TILT_DEG)):
        return None
    offset = float(normal @ point)
    return Plane(normal, offset, int((np.abs(near @ normal - offset) < tolerance).sum()))


def _unit(v: F64) -> F64:
    return np.asarray(v / max(float(np.linalg.norm(v)), 1e-12))
