"""Where the outlines of masks cut a line: the visual hull, finer than its cells."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from refdgs_pipe.camera import F64, Camera

F32 = NDArray[np.float32]

_STOPS = 9  # along a line, before halving
_HALVINGS = 5


def outline_shifts(
    points: F64, normals: F64, reach: float, cameras: list[Camera], masks: list[F32], doubters: int
) -> F64:
    """(N,) how far along its normal a point lies from the hull's surface, 0 where none is near.

    A place is inside where all masks but `doubters` cover at least half of the pixel that shows it.

    Args:
        points, normals: (N, 3), world, normals unit and outward.
        reach: world units looked at to either side.
        masks: (H, W) in [0, 1] for each camera, at its size.
    """

    def inside(shifts: F64) -> NDArray[np.bool_]:
        places = points + shifts[:, None] * normals
        return _least_cover(places, cameras, masks, doubters) >= 0.5

    stops = np.linspace(-reach, reach, _STOPS)
    found = np.stack([inside(np.full(len(points), stop)) for stop in stops])
    leaves = found[:-1] & ~found[1:]
    first = leaves.argmax(0)
    low, high = stops[first], stops[first + 1]
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        still = inside(middle)
        low, high = np.where(still, middle, low), np.where(still, high, middle)
    return np.where(leaves.any(0) & found[0], (low + high) / 2, 0.0)


def _least_cover(points: F64, cameras: list[Camera], masks: list[F32], doubters: int) -> F32:
    """(N,) the least that a mask covers of a point, but for the `doubters` least of all."""
    covers = np.ones((len(cameras), len(points)), np.float32)
    for cover, camera, mask in zip(covers, cameras, masks, strict=True):
        uv, depth = camera.project(points)
        seen = (depth > 0) & (uv >= 0).all(1) & (uv < (camera.width, camera.height)).all(1)
        cover[seen] = map_coordinates(mask, uv[seen, ::-1].T - 0.5, order=1, mode="nearest")
    which = min(doubters, len(cameras) - 1)
    least: F32 = np.partition(covers, which, axis=0)[which]
    return least
