"""Pinhole cameras and lenses: the one place that states the conventions.

OpenCV cameras: x right, y down, z forward. Pixel (i, j) covers [i, i+1) x [j, j+1) and has its
centre at (i + 0.5, j + 0.5). Transforms are `target_from_source`. Depth is the camera's z.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Box = tuple[int, int, int, int]
"""First column, column after the last, first row, row after the last: left, right, top, bottom."""

ROOM = 1.1  # of a ball's radius, to which views are cut: outlines need pixels on both sides


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion, and where it stood.

    Args:
        name: the view's name, unique in its capture.
        width, height: pixels.
        K: (3, 3) intrinsics in pixels.
        cam_from_world: (4, 4) rigid transform.
        split: "train", or "test" for a view held out from training.
    """

    name: str
    width: int
    height: int
    K: F64
    cam_from_world: F64
    split: str = "train"

    @property
    def world_from_cam(self) -> F64:
        R, t = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = R.T, -R.T @ t
        return out

    @property
    def center(self) -> F64:
        """(3,) position in the world."""
        return center_of(self.cam_from_world)

    def resized(self, width: int, height: int) -> "Camera":
        """The same camera for an image resampled to another size."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, width=width, height=height, K=scale @ self.K)

    def fitted(self, longest: int) -> "Camera":
        """The same camera for an image whose longer side is at most `longest` pixels."""
        scale = longest / max(self.width, self.height)
        if scale >= 1:
            return self
        size = (max(1, round(side * scale)) for side in (self.width, self.height))
        return self.resized(*size)

    def part(self, left: int, right: int, top: int, bottom: int) -> "Camera":
        """The camera of columns left to right - 1, rows top to bottom - 1, of its photo."""
        K = self.K.copy()
        K[:2, 2] -= (left, top)
        return replace(self, width=right - left, height=bottom - top, K=K)

    def box_of(self, center: F64, radius: float) -> Box | None:
        """The pixels in which a ball can be seen.

        In the plane of the optical axis and the image's x axis (or y axis) the ball is a circle.
        Its tangents from the origin are the directions to its centre, turned by asin(radius /
        distance) both ways. None: no pixel shows it. The whole photo if it is around or beside
        the camera.
        """
        R, t = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        at = R @ center + t
        box = []
        for axis, whole in ((0, self.width), (1, self.height)):
            distance = float(np.hypot(at[axis], at[2]))
            ends = (0.0, float(whole))
            if distance > radius:
                toward = np.arctan2(at[axis], at[2]), np.arcsin(radius / distance)
                angles = np.array([toward[0] - toward[1], toward[0] + toward[1]])
                if (np.abs(angles) < np.pi / 2).all():
                    seen = self.K[axis, axis] * np.tan(angles) + self.K[axis, 2]
                    ends = (float(np.floor(seen[0])), float(np.ceil(seen[1])))
            box += [int(min(max(end, 0), whole)) for end in ends]
        return None if box[0] >= box[1] or box[2] >= box[3] else (box[0], box[1], box[2], box[3])

    def framed(self, center: F64, radius: float) -> "Camera":
        """The part within `frame`."""
        return self.part(*self.frame(center, radius))

    def frame(self, center: F64, radius: float) -> Box:
        """The pixels that can show a ball, and some room; all pixels if none shows it."""
        box = self.box_of(center, ROOM * radius)
        return (0, self.width, 0, self.height) if box is None else box

    def pixel_rays(self) -> F64:
        """(H, W, 3) camera-space rays through the pixel centres, with z = 1."""
        x, y = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        pixels = np.stack([x, y, np.ones_like(x)], -1)
        return np.asarray(pixels @ np.linalg.inv(self.K).T)

    def project(self, points: F64) -> tuple[F64, F64]:
        """Pixel coordinates (N, 2) and depths (N,) of world points (N, 3)."""
        p = points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            uv = (p @ self.K.T)[:, :2] / p[:, 2:]
        return uv, p[:, 2]


@dataclass(frozen=True)
class Lens:
    """What a photo was taken through: OpenCV's radial-tangential model.

    Args:
        K: (3, 3) intrinsics of the photo as taken, pixels.
        distortion: (8,) k1 k2 p1 p2 k3 k4 k5 k6, zeros for a pinhole.
    """

    K: F64
    distortion: F64

    @property
    def is_pinhole(self) -> bool:
        return not self.distortion.any()


def center_of(cam_from_world: F64) -> F64:
    """(3,) where a camera with this pose (4, 4) stands, world units."""
    return np.asarray(-cam_from_world[:3, :3].T @ cam_from_world[:3, 3], np.float64)


def look_at(eye: F64, target: F64, up: F64) -> F64:
    """(4, 4) cam_from_world of a camera at `eye` that looks at `target`, upright; world units.

    Args:
        up: (3,) not along the line of sight.
    """
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def opencv_from_opengl(world_from_cam: F64) -> F64:
    """cam_from_world (OpenCV) of an OpenGL camera-to-world matrix (y up, looks along -z)."""
    flipped = world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
    return np.asarray(np.linalg.inv(flipped), np.float64)
