"""How the light moves from photo to photo, and what was fitted of it."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import CorruptError

F64 = NDArray[np.float64]
Kind = Literal["world", "turntable", "flash"]
BANDS = 6  # real spherical harmonics of degree 1 and 2 that change as the room turns
_FILE = "lighting.json"


@dataclass(frozen=True)
class Ring:
    """Photos of a turntable that were taken with one setting of the tripod.

    Args:
        height: of the camera along the axis, from `Turntable.center`, world units.
        radius: its distance from the axis, world units.
        turn: the camera's azimuth in the room, less that of the first ring, in radians.
    """

    height: float
    radius: float
    turn: float = 0.0


@dataclass(frozen=True)
class Turntable:
    """The axis that the object turns about while camera and room stand still.

    Args:
        center: (3,) a point on the axis, world.
        axis: (3,) unit, upwards, world.
        rings: at least one.
        shade: (6, 3) how much more or less light a surface gets that faces a direction in the
            room, relative to its mean over a whole turn: factors of x, y, xy, yz, xz, x^2 - y^2
            along (`sides`, `axis`), linear RGB; 0 if not fitted yet.
    """

    center: F64
    axis: F64
    rings: tuple[Ring, ...]
    shade: F64

    @property
    def sides(self) -> tuple[F64, F64]:
        """Two unit directions (3,) that are orthogonal to the axis and each other."""
        return sides_of(self.axis)

    def room_from_world(self, center: F64) -> F64:
        """(3, 3) rotation of directions into the room's frame for a camera at `center` (3,).

        The room is the world as it lies for a camera at azimuth 0 of the first ring.
        """
        first, second = self.sides
        from_axis = center - self.center
        height, x, y = from_axis @ self.axis, from_axis @ first, from_axis @ second
        radius = np.hypot(x, y)
        apart = [(height - r.height) ** 2 + (radius - r.radius) ** 2 for r in self.rings]
        azimuth = float(np.arctan2(y, x))
        return turned(self.axis, self.rings[int(np.argmin(apart))].turn - azimuth)


@dataclass(frozen=True)
class Flash:
    """A small lamp that moves with the camera.

    Args:
        lamp: (3,) its place in the camera's frame (x right, y down, z forward), world units.
        distance: from the lamp, world units, at which a surface that faces it has factor 1.
        room: share of the light that comes from the room instead, 0 to 1.
    """

    lamp: F64
    distance: float
    room: float


@dataclass(frozen=True)
class Lighting:
    """What the light does while the photos are taken.

    Args:
        kind: "world": it stands still with the object; "turntable": object and table turn in a
            room that stands still; "flash": a lamp on the camera, and some light of the room.
        reason: why this was found, in one sentence.
        turntable, flash: of that kind only.
    """

    kind: Kind
    reason: str = ""
    turntable: Turntable | None = None
    flash: Flash | None = None

    @property
    def lamp(self) -> F64 | None:
        """(3,) where a flash is in the camera's frame; None without one."""
        return None if self.flash is None else self.flash.lamp

    def lamp_of(self, camera: Camera) -> NDArray[np.float32] | None:
        """(3,) where a flash on the camera is in the world; None without one."""
        if self.flash is None:
            return None
        place = camera.center + self.flash.lamp @ camera.cam_from_world[:3, :3]
        return np.asarray(place, np.float32)

    def light_from_world(self, center: F64) -> F64:
        """(3, 3) rotation of world directions into the frame where the far light stands still.

        Args:
            center: (3,) of the camera, world.
        """
        return np.eye(3) if self.turntable is None else self.turntable.room_from_world(center)

    def record(self) -> dict[str, Any]:
        """As JSON holds it."""
        out: dict[str, Any] = {"kind": self.kind, "reason": self.reason}
        if (t := self.turntable) is not None:
            out["turntable"] = {
                "center": t.center.tolist(),
                "axis": t.axis.tolist(),
                "rings": [[ring.height, ring.radius, ring.turn] for ring in t.rings],
                "shade": t.shade.tolist(),
            }
        if (f := self.flash) is not None:
            out["flash"] = {"lamp": f.lamp.tolist(), "distance": f.distance, "room": f.room}
        return out

    @classmethod
    def of(cls, record: dict[str, Any]) -> Self:
        """Inverse of `record`.

        Raises:
            ValueError, KeyError, TypeError: it is none.
        """
        kind, turntable, flash = record["kind"], None, None
        if kind not in get_args(Kind):
            raise ValueError(f"the light is {kind!r}, not one of {', '.join(get_args(Kind))}")
        if kind == "turntable":
            t = record["turntable"]
            rings = tuple(Ring(*(float(v) for v in ring)) for ring in t["rings"])
            if not 1 <= len(rings) <= 1000:
                raise ValueError("a turntable has 1 to 1000 rings")
            axis = _finite(t["axis"], (3,))
            if abs(np.linalg.norm(axis) - 1) > 1e-3:
                raise ValueError("the axis is no unit vector")
            shade = _finite(t["shade"], (BANDS, 3))
            turntable = Turntable(_finite(t["center"], (3,)), axis, rings, shade)
        if kind == "flash":
            f = record["flash"]
            flash = Flash(_finite(f["lamp"], (3,)), float(f["distance"]), float(f["room"]))
            if not (flash.distance > 0 and 0 <= flash.room <= 1):
                raise ValueError("the flash has an impossible distance or share")
        return cls(kind, str(record["reason"]), turntable, flash)

    def save(self, folder: Path) -> None:
        """Write one JSON file."""
        (folder / _FILE).write_text(json.dumps(self.record(), indent=1), "utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: the file is missing or damaged.
        """
        try:
            return cls.of(json.loads((folder / _FILE).read_text("utf-8")))
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise CorruptError(
                f"{folder / _FILE}: not a readable lighting ({error}): run the stage lighting again"
            ) from error

    def with_turns(self, turns: list[float], shade: F64) -> Self:
        """The lighting of a turntable with what was fitted: a turn for each ring, and the shade."""
        assert self.turntable is not None
        pairs = zip(self.turntable.rings, turns, strict=True)
        rings = tuple(replace(ring, turn=turn) for ring, turn in pairs)
        return replace(self, turntable=replace(self.turntable, rings=rings, shade=shade))


WORLD = Lighting("world")


def angle_of(turn: F64, axis: F64) -> float:
    """The angle, in radians, of a rotation (3, 3) about a unit axis (3,)."""
    return float(np.arctan2(sine_of(turn) @ axis, (np.trace(turn) - 1) / 2))


def sine_of(turn: F64) -> F64:
    """(3,) the axis of a rotation (3, 3), as long as the sine of its angle."""
    differences = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    return np.asarray(differences) / 2


def sides_of(axis: F64) -> tuple[F64, F64]:
    """Two unit directions (3,) that are orthogonal to a unit axis (3,) and each other."""
    first = np.cross(np.eye(3)[int(np.abs(axis).argmin())], axis)
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def turned(axis: F64, angle: float) -> F64:
    """(3, 3) rotation about a unit axis (3,) by an angle in radians (Rodrigues' formula)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    along = np.outer(axis, axis)
    return np.asarray(along + np.cos(angle) * (np.eye(3) - along) + np.sin(angle) * cross)


def _finite(values: Any, shape: tuple[int, ...]) -> F64:
    found = np.array(values, np.float64)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"{shape} finite numbers were expected")
    return found
