"""A spotted plane with boxes on it, as cameras round it see it."""

import numpy as np

from refdgs_pipe.camera import F64
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32

N, REACH = 256, 2.2
GROUND = Ground(np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), REACH)
TABLE, BLACK, WHITE = -0.7, -3.0, -0.1
Box = tuple[tuple[float, float, float], tuple[float, float, float], float]
BODY: Box = ((-0.4, -0.3, 0.0), (0.4, 0.3, 0.25), BLACK)
FLAT: Box = ((-0.4, -0.3, 0.0), (0.4, 0.3, 0.0), BLACK)


def cameras() -> F64:
    """(16, 3) round the middle, at two heights."""
    turn = np.arange(16) / 16 * 2 * np.pi
    height = np.deg2rad(np.where(np.arange(16) % 2, 20, 50))
    out = np.stack([np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.sin(height)])
    return np.asarray(3 * out.T)


def shown(boxes: list[Box], contrast: float = 0.4, strip: float | None = None) -> F32:
    """(16, N, N, 3) a spotted plane and boxes (low, high, log colour), as each camera sees them.

    Args:
        contrast: standard deviation of the spots, log colour.
        strip: log colour of a strip of the plane, from the middle outwards; None for no strip.
    """
    rng = np.random.default_rng(0)
    spots = rng.normal(TABLE, contrast, (N // 8, N // 8, 1)).repeat(8, 0).repeat(8, 1)
    place = ((np.arange(N) + 0.5) / N * 2 - 1) * REACH
    x, y = np.meshgrid(place, place)
    ends = np.stack([x, y, np.zeros_like(x)], -1)
    if strip is not None:
        spots = np.where(((np.abs(y) < 0.1) & (x > 0))[..., None], strip, spots)
    out = np.empty((16, N, N, 3), np.float32)
    for photo, eye in zip(out, cameras(), strict=True):
        photo[:] = spots
        nearest = np.full((N, N), 1.0 + 1e-6)
        for low, high, colour in boxes:
            with np.errstate(divide="ignore"):
                one, other = ((np.array(side) - eye) / (ends - eye) for side in (low, high))
            enters, leaves = np.minimum(one, other).max(-1), np.maximum(one, other).min(-1)
            hit = (enters <= leaves + 1e-9) & (enters < nearest)
            photo[hit], nearest[hit] = colour, enters[hit]
        photo += rng.normal(0, 0.02, photo.shape)
    return out
