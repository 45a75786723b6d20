"""The frame of every exported file: +Y up, +Z to the front, metres."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.geometry import y_up_from_z_up
from refdgs_pipe.light import looked_up

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


@dataclass(frozen=True)
class AssetFrame:
    """How the world becomes the asset.

    Args:
        turn: (3, 3) rotation, asset from world.
        metres_per_unit: of the world.
    """

    turn: F64
    metres_per_unit: float

    @classmethod
    def of(cls, up: F64, metres_per_unit: float) -> Self:
        """The frame for a world with that unit up vector."""
        return cls(y_up_from_z_up(up), metres_per_unit)

    def points(self, world: F32 | F64) -> F64:
        """(N, 3) positions in metres."""
        return np.asarray(world @ self.turn.T * self.metres_per_unit, np.float64)

    def directions(self, world: F32 | F64) -> F64:
        """(..., 3) directions, as long as before."""
        return np.asarray(world @ self.turn.T, np.float64)

    def to_world(self, directions: F32 | F64) -> F64:
        """(..., 3) directions of the asset, in the world."""
        return np.asarray(directions @ self.turn, np.float64)


def latlong_light(frame: AssetFrame, light: F32 | None, height: int) -> F32 | None:
    """(height, 2 height, 3) the world's light, laid out as `latlong_directions` says.

    Args:
        light: laid out as `refdgs_pipe.light` says; None stays None.
    """
    if light is None:
        return None
    return looked_up(light, frame.to_world(latlong_directions(height)))


def latlong_directions(height: int) -> F64:
    """(H, 2H, 3) unit directions of a lat-long picture's texel centres, +Y up.

    As in OpenEXR and USD: the top row is +Y, the centre column +Z, a quarter from the left +X,
    the left and right edges -Z. Seen from inside, nothing is mirrored.
    """
    rows = (np.arange(height) + 0.5) / height
    columns = (np.arange(2 * height) + 0.5) / (2 * height)
    latitude, longitude = np.meshgrid(
        (0.5 - rows) * np.pi, (0.5 - columns) * 2 * np.pi, indexing="ij"
    )
    level = np.cos(latitude)
    return np.stack(
        [level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)], axis=-1
    )
