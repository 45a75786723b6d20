"""Where photos were taken from, as directions round the object."""

from dataclasses import dataclass

import numpy as np

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.geometry import widest_stretch, y_up_from_z_up


@dataclass(frozen=True)
class Direction:
    """One photo seen from the object, degrees.

    Args:
        azimuth: round the up axis, from -180 to 180; 0 is the asset's front.
        height: above the horizon through the object's middle.
    """

    name: str
    azimuth: float
    height: float


@dataclass(frozen=True)
class Around:
    """All photos round the object.

    Args:
        widest: (start, end) azimuths of the widest stretch without a photo, end > start.
    """

    directions: tuple[Direction, ...]
    widest: tuple[float, float]

    @property
    def gap_deg(self) -> float:
        return self.widest[1] - self.widest[0]

    @property
    def heights(self) -> tuple[float, float]:
        """The lowest and the highest."""
        found = [direction.height for direction in self.directions]
        return min(found), max(found)


def around(model: SparseModel) -> Around | None:
    """The directions of a model's photos; None for fewer than two."""
    turn = y_up_from_z_up(model.up)
    found = []
    for camera in model.cameras:
        x, y, z = turn @ (camera.center - model.ball.center)
        length = float(np.linalg.norm([x, y, z]))
        if length > 0:
            azimuth = float(np.degrees(np.arctan2(x, z)))
            height = float(np.degrees(np.arcsin(np.clip(y / length, -1, 1))))
            found.append(Direction(camera.name, azimuth, height))
    if len(found) < 2:
        return None
    return Around(tuple(found), widest_stretch([direction.azimuth for direction in found]))
