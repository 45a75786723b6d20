"""Points of a surface, and which of them a view shows."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import Camera

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# A part that was moved after training, as a bulge that was made flat, lies off the field's maps.
MOVED = 4.0  # tolerances
_ROW = 1024  # cv2.remap refuses more than 32767 rows or columns


@dataclass(frozen=True, eq=False)
class Shown:
    """What a view shows of M points.

    Args:
        rows: (M,) which points.
        pixels: (M, 2) their pixel coordinates, centres at + 0.5.
        cosine: (M,) between the normal and the way to the eye.
        depth: (M,) along the camera's axis, world units.
        layers: (M, C) what was looked up at these pixels.
        near: (M,) whether the depth map lies within the tolerance.
    """

    rows: Ints
    pixels: F32
    cosine: F32
    depth: F32
    layers: F32
    near: Bools


class SurfacePoints:
    """N points of a surface.

    Args:
        points: (N, 3) world; normals: (N, 3) unit.
    """

    def __init__(self, points: F32, normals: F32) -> None:
        self.points, self.normals = points, normals
        self._offset = np.einsum("nc,nc->n", points, normals)

    def shown(
        self,
        camera: Camera,
        layers: F32,
        *,
        tolerance: float,
        least_cosine: float,
        moved: float = 0.0,
        part: slice = slice(None),
    ) -> Shown:
        """The points that lie on a view's depth map.

        Args:
            layers: (H, W, C) depth along the camera's axis; 1 where it can be trusted, else 0; and
                whatever else is to be looked up.
            tolerance: how far a point may lie from the depth map, world units.
            moved: how far the depth map may lie from a point that the tolerance leaves out, world
                units; 0: such points are not shown.
            part: the points that are asked for; rows count from its start.
        """
        points, normals = self.points[part], self.normals[part]
        R, t = (camera.cam_from_world[:3, i].astype(np.float32) for i in (slice(3), 3))
        # Whole rows of three are slow to reduce; half of the points go by what one product tells.
        height = normals @ camera.center.astype(np.float32) - self._offset[part]
        rows = np.flatnonzero((height > 0) & (points @ R[2] + t[2] > 0))
        x, y, z = R @ points[rows].T + t[:, None]
        cosine = np.minimum(height[rows] / np.sqrt(x * x + y * y + z * z), 1)  # rounding
        K = camera.K.astype(np.float32)
        u, v = x / z * K[0, 0] + K[0, 2], y / z * K[1, 1] + K[1, 2]
        inside = (u > 0.5) & (v > 0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
        good = np.flatnonzero(inside & (cosine > least_cosine))
        rows, cosine, z = rows[good], cosine[good], z[good]
        pixels = np.stack([u[good], v[good]], 1)
        sampled = bilinear(layers, pixels)
        slope = np.sqrt(1 / cosine**2 - 1)
        allowed = tolerance + slope * z / float(K[0, 0])
        gap = np.abs(sampled[:, 0] - z)
        near = gap < allowed
        good = np.flatnonzero((near | (gap < moved)) & (sampled[:, 1] > 0.999))
        return Shown(rows[good], pixels[good], cosine[good], z[good], sampled[good], near[good])


def bilinear(values: F32, pixels: F32) -> F32:
    """(N, C) values (H, W, C) at pixel coordinates (N, 2), centres at + 0.5."""
    count = len(pixels)
    if not count:
        return np.empty((0, values.shape[-1]), np.float32)
    padded = np.zeros((-(-count // _ROW) * _ROW, 2), np.float32)
    padded[:count] = pixels - 0.5
    x, y = (np.ascontiguousarray(padded[:, i].reshape(-1, _ROW)) for i in range(2))
    parts = []
    for start in range(0, values.shape[-1], 4):
        part = np.ascontiguousarray(values[..., start : start + 4], np.float32)
        found = cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        parts.append(np.asarray(found).reshape(len(padded), -1)[:count])
    return np.concatenate(parts, 1)
