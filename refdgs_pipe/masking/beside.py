"""Things that stand on the plane beside the object: they are none of it.

People photograph an object on a desk with other things on it. All photos look at the object. So a
small thing is none of it if it stands outside of the circle, round the place that photos look at,
that the object fills. Several things of like size are a set, and all of them stay.
"""

import numpy as np
from scipy.ndimage import label, minimum

from refdgs_pipe.camera import F64
from refdgs_pipe.ground.shots import Bools
from refdgs_pipe.masking.solid import Cells

SMALL = 0.25  # of the object's cells, that a thing beside it has at most
OUTSIDE = 1.15  # of the circle's radius, from which on things stand beside the object
THING = 0.01  # of the object's cells, from which on a piece counts as a thing
STANDS = 3.0  # cells above the plane, where the lowest of what stands on it lies at most


def without_bystanders(
    cells: Cells, solid: Bools, plane: tuple[F64, float], middle: F64
) -> tuple[Bools, int]:
    """(n ** 3,) the solid without the things beside its largest piece, and how many these are.

    Nothing is left out if the largest piece does not stand on the plane: what holds it may be
    missing, and another piece may be its foot.

    Args:
        plane: unit normal and offset; middle: (3,) where the photos look at, world.
    """
    normal, offset = plane
    pieces, count = label(solid.reshape((cells.n,) * 3))
    if count < 2:
        return solid, 0
    height = cells.points @ normal - offset
    away = cells.points - middle
    away = np.linalg.norm(away - (away @ normal)[:, None] * normal, axis=1)
    index, where = np.arange(1, count + 1), pieces.ravel()
    sizes = np.bincount(where)[1:]
    largest = int(sizes.argmax())
    stands = minimum(height, where, index) <= STANDS * cells.size
    if not stands[largest]:
        return solid, 0
    circle = OUTSIDE * away[where == largest + 1].max()
    small = sizes < SMALL * sizes[largest]
    beside = small & stands & (minimum(away, where, index) > circle)
    things = int((beside & (sizes >= THING * sizes[largest])).sum())
    return np.asarray(solid & ~np.append(False, beside)[where]), things
