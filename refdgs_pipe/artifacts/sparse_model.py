"""Where every photo was taken, and what of the object was seen from there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import Camera, Lens

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Ball:
    """The ball that the object lives in, world units."""

    center: F64
    radius: float


@dataclass(frozen=True)
class Lost:
    """A view that found no place."""

    name: str
    reason: str


@dataclass(frozen=True)
class SparseModel:
    """Posed, distortion-free cameras and sparse points, all in the world frame of every later file.

    World frame: for known poses the input's own; for photos z is up, the origin is the object's
    centre on its support, and one unit is the object ball's radius (or a metre if known).

    Args:
        cameras: one per posed view, sorted by name, at the size of the view's image.
        lenses: view name -> lens of the photo as taken; `photos.load_photo` removes it.
        points: (P, 3) float64; point_colors: (P, 3) uint8 sRGB; P may be 0 (known poses).
        tracks: for each camera name the (n,) int indices of the points it sees.
        ball: the object ball.
        up: (3,) unit vector, world.
        sfm_from_world: (4, 4) similarity back to the frame of the structure from motion.
        metres_per_unit: None when nothing told the scale.
        lost: views without a pose and why.
    """

    cameras: tuple[Camera, ...]
    lenses: dict[str, Lens]
    points: F64
    point_colors: NDArray[np.uint8]
    tracks: dict[str, NDArray[np.int64]]
    ball: Ball
    up: F64
    sfm_from_world: F64
    metres_per_unit: float | None
    lost: tuple[Lost, ...]
