"""Rings of photos that a camera on a tripod takes of an object on a turntable.

Seen from the object, such a camera moves on a circle about the table's axis and always looks at
the axis in the same way. A camera in a hand does not: it sways by degrees and by centimetres.
"""

from dataclasses import dataclass

import numpy as np

from refdgs_pipe.artifacts.lighting import BANDS, Ring, Turntable, sides_of, sine_of, turned
from refdgs_pipe.camera import F64, Camera

ANGLE = np.radians(1.5)  # the way that cameras of one ring look at the axis differs by less
SHIFT = 0.015  # and their height and distance, of the distance to the centre
FEWEST = 5  # photos of a ring
_SLACK = (3.0, 1.5, 1.0)  # of both limits, while axis and rings are found in turn


@dataclass(frozen=True)
class Rings:
    """What was found.

    Args:
        turntable: the axis and its rings.
        members: for each ring the indices of its cameras, by azimuth.
        share: of the cameras that belong to a ring.
    """

    turntable: Turntable
    members: tuple[tuple[int, ...], ...]
    share: float


def find_rings(cameras: tuple[Camera, ...], center: F64, up: F64) -> Rings | None:
    """Rings about one axis near `up` that passes close to `center`; None where there are none.

    Args:
        center: (3,) of the object ball, world; up: (3,) unit.
    """
    if len(cameras) < FEWEST:
        return None
    places = np.stack([camera.center for camera in cameras])
    rotations = np.stack([camera.cam_from_world[:3, :3] for camera in cameras])
    distance = float(np.median(np.linalg.norm(places - center, axis=1)))
    axis, point = up / np.linalg.norm(up), center
    members: list[list[int]] = []
    for slack in _SLACK:
        members = _grouped(places - point, rotations, axis, distance, slack)
        if not members:
            return None
        axis = _axis(rotations, members, axis)
        point = _point(places, members, axis, center)
    first, second = sides_of(axis)
    rings = []
    for ring in members:
        apart = places[ring] - point
        height = float(np.mean(apart @ axis))
        radius = float(np.mean(np.hypot(apart @ first, apart @ second)))
        rings.append(Ring(height, radius))
        order = np.argsort(np.arctan2(apart @ second, apart @ first))
        ring[:] = [ring[i] for i in order]
    found = Turntable(point, axis, tuple(rings), np.zeros((BANDS, 3)))
    share = sum(len(ring) for ring in members) / len(cameras)
    return Rings(found, tuple(tuple(ring) for ring in members), share)


def _grouped(
    places: F64, rotations: F64, axis: F64, distance: float, slack: float
) -> list[list[int]]:
    """Cameras that look at the axis alike, the largest group first.

    Args:
        places: (N, 3) from a point on the axis.
    """
    first, second = sides_of(axis)
    x, y, height = places @ first, places @ second, places @ axis
    radius = np.hypot(x, y)
    # what the camera's rotation is once its azimuth is taken away
    alike = np.stack(
        [r @ turned(axis, a) for r, a in zip(rotations, np.arctan2(y, x), strict=True)]
    )
    trace = np.einsum("aij,bij->ab", alike, alike)
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    far = np.hypot(height[:, None] - height, radius[:, None] - radius)
    near = (angle < slack * ANGLE) & (far < slack * SHIFT * distance)
    left = np.ones(len(places), bool)
    groups: list[list[int]] = []
    while True:
        counts = (near & left).sum(1) * left
        middle = int(counts.argmax())
        if counts[middle] < FEWEST:
            return groups
        ring = np.flatnonzero(near[middle] & left)
        groups.append([int(i) for i in ring])
        left[ring] = False


def _axis(rotations: F64, members: list[list[int]], axis: F64) -> F64:
    """(3,) the axis of the rotations from photo to photo of the rings."""
    total = np.zeros(3)
    for ring in members:
        for step in range(1, len(ring) // 2 + 1):
            for i, j in zip(ring, ring[step:], strict=False):
                part = sine_of(rotations[i].T @ rotations[j])  # short where it is badly known
                total += part * np.sign(part @ axis)
    length = float(np.linalg.norm(total))
    return axis if length < 1e-9 else total / length


def _point(places: F64, members: list[list[int]], axis: F64, center: F64) -> F64:
    """(3,) where the axis is: the centre of all rings' circles, by least squares."""
    first, second = sides_of(axis)
    rows, wanted = [], []
    for number, ring in enumerate(members):
        apart = places[ring] - center
        flat = np.stack([apart @ first, apart @ second], 1)
        own = np.zeros((len(ring), len(members)))
        own[:, number] = 1
        rows.append(np.hstack([2 * flat, own]))
        wanted.append((flat**2).sum(1))
    solution = np.linalg.lstsq(np.vstack(rows), np.concatenate(wanted), rcond=None)[0]
    return np.asarray(center + solution[0] * first + solution[1] * second)
