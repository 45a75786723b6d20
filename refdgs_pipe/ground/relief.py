"""How far the ground is from the plane that was found for it: folded paper, cloth, a bent board.

Where the ground is higher by h, a photo shows its print farther away from the camera by h times the
cotangent of the elevation. The print of the picture itself may also be misplaced by a little, in
the same way for all photos. Both follow from the places that many photos show.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from refdgs_pipe.camera import F64
from refdgs_pipe.ground.plane import Ground

CELLS = 48  # of the relief, along an edge
SMOOTH = 0.7  # cells
NOISE, SOFT = 0.004, 0.01  # of the ball's radius: spread of a place; farther ones count less
ASIDE, HIGH = 0.005, 0.02  # of the ball's radius: spread of the print's misplacement, of heights
STEPS = 5


@dataclass(frozen=True)
class Places:
    """Places that one photo shows, on the axes of the ground, in radii of the ball.

    Args:
        at: (n, 2) where the picture of the plane has them.
        miss: (n, 2) by how much farther the photo shows them.
        away: (n, 2) by how much farther they would be shown if they were higher by 1.
        sine: (n,) of the elevation at which the photo sees them.
    """

    at: F64
    miss: F64
    away: F64
    sine: F64

    @classmethod
    def of(cls, ground: Ground, center: F64, points: F64, shown: F64, radius: float) -> "Places":
        """From points (n, 3) of the picture and where (n, 3) on the plane a photo shows them.

        Args:
            center: (3,) of the camera; radius: of the ball, world units.
        """
        axes = np.stack([ground.a, ground.b], 1)
        height = float((center - ground.origin) @ np.cross(ground.a, ground.b))
        rays = points - center
        sine = np.abs(height) / np.linalg.norm(rays, axis=1)
        at, miss = (points - ground.origin) @ axes, (shown - points) @ axes
        return cls(at / radius, miss / radius, rays @ axes / height, sine)


def relief(places: list[Places], reach: float) -> F64:
    """(CELLS, CELLS, 3) misplacement along both axes, and height, in radii of the ball.

    Args:
        reach: of the ground from its origin, radii of the ball.
    """
    at, miss, away = (
        np.concatenate([getattr(p, k) for p in places]) for k in ("at", "miss", "away")
    )
    weight = np.concatenate([p.sine for p in places]) ** 2
    column, row = ((at / reach + 1) / 2 * CELLS).astype(int).clip(0, CELLS - 1).T
    J = np.zeros((len(at), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1
    J[:, :, 2] = away
    prior = np.diag([(NOISE / ASIDE) ** 2, (NOISE / ASIDE) ** 2, (NOISE / HIGH) ** 2])
    found = np.zeros((CELLS, CELLS, 3))
    for _ in range(STEPS):
        off = miss - np.einsum("nij,nj->ni", J, found[row, column])
        w = weight / (1 + (off**2).sum(1) * weight / SOFT**2)
        A, b = np.zeros((CELLS, CELLS, 3, 3)), np.zeros((CELLS, CELLS, 3))
        np.add.at(A, (row, column), np.einsum("nki,n,nkj->nij", J, w, J))
        np.add.at(b, (row, column), np.einsum("nki,n,nk->ni", J, w, miss))
        A = gaussian_filter(A, (SMOOTH, SMOOTH, 0, 0)) + prior
        b = gaussian_filter(b, (SMOOTH, SMOOTH, 0))
        found = np.linalg.solve(A, b[..., None])[..., 0]
    return found


def lifted(ground: Ground, points: F64, found: F64, radius: float) -> F64:
    """(N, 3) points of the plane, moved to where the relief says that they are."""
    reach = ground.radius
    s, t = (points - ground.origin) @ ground.a, (points - ground.origin) @ ground.b
    place = [(c / reach + 1) / 2 * CELLS - 0.5 for c in (t, s)]
    aside, over, up = (
        radius * map_coordinates(found[..., k], place, order=1, mode="nearest") for k in range(3)
    )
    normal = np.cross(ground.a, ground.b)
    return np.asarray(
        points + aside[:, None] * ground.a + over[:, None] * ground.b + up[:, None] * normal
    )
