"""Where a photo shows what photos from above hold for solid, in front of the room.

Beside the plane, a photo has the room and colours to tell the object by. A mirror has the colours
of the room. But photos from above see the same part before the plane, whose picture is certain.
"""

import numpy as np

from refdgs_pipe.ground.shots import F32, Bools, Shot
from refdgs_pipe.masking.solid import SHOWN, Cells, polled, silhouette

CLEARLY = 0.3  # evidence for the plane, from which on it denies a cell
MANY, HARDLY = 0.25, 0.1  # share of the photos that must tell of a cell, and that may deny it


def held(cells: Cells, shots: list[Shot], values: list[F32], asked: list[Bools]) -> list[Bools]:
    """(H, W) of each photo: the silhouette of the hull that the plane leaves.

    Args:
        values: (H, W) evidence for what is behind the object.
        asked: (H, W) where this evidence comes from the plane, and is known.
    """
    free = [~(a & (v > CLEARLY)) for a, v in zip(asked, values, strict=True)]
    index = np.flatnonzero(cells.inside)
    index, seen, told, denied = polled(cells, index, shots, free, asked, HARDLY)
    left = (seen >= SHOWN * len(shots)) & (told >= MANY * len(shots)) & (denied <= HARDLY * told)
    solid = np.zeros(len(cells.points), bool)
    solid[index[left]] = True
    return [silhouette(cells, solid, shot) for shot in shots]
