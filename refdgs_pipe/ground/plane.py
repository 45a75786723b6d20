"""A picture of a plane, drawn from photos and drawn into photos."""

from dataclasses import dataclass

import cv2
import numpy as np

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.geometry import homography_warp
from refdgs_pipe.ground.shots import F32

OVERSAMPLED = (2, 4)  # places of a photo's pixel, across and down, at which a picture is looked up


@dataclass(frozen=True)
class Ground:
    """A plane in the world, with axes: x = origin + s a + t b.

    Args:
        radius: how far the picture reaches from the origin, world units.
    """

    origin: F64
    a: F64
    b: F64
    radius: float

    @classmethod
    def under(cls, ball: Ball, normal: F64, offset: float, radius: float) -> "Ground":
        """The plane normal . x = offset, with the origin below the ball's centre."""
        other = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.9 else np.array([0, 1.0, 0])
        a = np.cross(normal, other)
        a /= np.linalg.norm(a)
        origin = ball.center - (normal @ ball.center - offset) * normal
        return cls(origin, a, np.cross(normal, a), radius)

    def height(self, point: F64) -> float:
        """How far above the plane a point (3,) lies, world units."""
        return float((point - self.origin) @ np.cross(self.a, self.b))

    def homography(self, camera: Camera, cells: int) -> F64:
        """(3, 3) from the picture's coordinates to the photo's, both with centres at +0.5."""
        step = 2 * self.radius / cells
        corner = self.origin - self.radius * (self.a + self.b)
        columns = np.stack([self.a * step, self.b * step, corner])
        P = camera.K @ camera.cam_from_world[:3]
        return np.asarray(P @ np.concatenate([columns, [[0], [0], [1]]], 1).T)

    def points(self, camera: Camera, pixels: F64) -> F64:
        """(N, 3) where the rays through pixels (N, 2) meet the plane."""
        uv = np.c_[pixels, np.ones(len(pixels))] @ np.linalg.inv(self.homography(camera, 1)).T
        s, t = (2 * uv[:, :2] / uv[:, 2:] - 1).T[:, :, None] * self.radius
        return np.asarray(self.origin + s * self.a + t * self.b)

    def flattened(self, image: F32, camera: Camera, cells: int) -> F32:
        """(cells, cells, ...) the plane as a photo shows it; NaN where it does not."""
        H = self.homography(camera, cells)
        flat = homography_warp(image, H, cells, cells, np.nan)
        y, x = np.mgrid[0:cells, 0:cells] + 0.5
        flat[H[2, 0] * x + H[2, 1] * y + H[2, 2] <= 1e-9] = np.nan
        return flat

    def drawn(self, picture: F32, camera: Camera, outside: float = np.nan) -> F32:
        """(H, W, ...) a picture of the plane as a photo would show it.

        A pixel is the mean of many places: at a grazing view it shows several cells, one behind
        the other, and one of them alone would give false patterns.

        Args:
            picture: (cells, cells, ...).
            outside: what stands where there is no picture.
        """
        cells, (across, down) = len(picture), OVERSAMPLED
        H = self.homography(camera, cells)
        back = np.asarray(np.linalg.inv(H), np.float64)
        fine = back @ np.diag([1 / across, 1 / down, 1.0])
        width, height = camera.width, camera.height
        found = homography_warp(picture, fine, width * across, height * down, outside)
        out = np.asarray(cv2.resize(found, (width, height), interpolation=cv2.INTER_AREA))
        y, x = np.mgrid[0:height, 0:width] + 0.5
        u, v, w = (back[k, 0] * x + back[k, 1] * y + back[k, 2] for k in range(3))
        out[(H[2, 0] * u + H[2, 1] * v) / np.where(w == 0, 1e-12, w) + H[2, 2] <= 0] = outside
        return np.asarray(out, np.float32)
