"""Things that stand on the table beside the object, as on a desk; they are none of the object."""

import geom
from household import _lathe
from objects import TABLE_Z, Objects, _box
from scenes import LIN, obj


def _book(x: float, y: float, turn: float, colour: str) -> Objects:
    half = (0.34, 0.24, 0.05)
    mesh = geom.xf(_box(half, (0, 0, 0), turn), None, (x, y, TABLE_Z + half[2]))
    return [obj(f"book{x:.1f}", mesh, type="diffuse", base=LIN(colour))]


def _mug(x: float, y: float) -> Objects:
    body = [(1e-4, 0.0), (0.15, 0.0), (0.16, 0.02), (0.16, 0.4), (0.15, 0.4), (0.14, 0.05),
            (1e-4, 0.04)]  # fmt: skip
    mesh = _lathe(body, geom.rot("z", 0), (x, y, TABLE_Z))
    return [obj("mug", mesh, type="gloss", base=LIN("e8e4da"), alpha=0.08)]


def _ball(x: float, y: float) -> Objects:
    mesh = geom.sphere(0.16, (x, y, TABLE_Z + 0.16))
    return [obj("ball", mesh, type="gloss", base=LIN("3f7a35"), alpha=0.05)]


def far_apart() -> Objects:
    """A book, a mug and a ball, more than the object's size away from it."""
    return [*_book(1.7, 0.9, 25, "27508f"), *_mug(-1.5, 1.3), *_ball(-0.9, -1.8)]


def close_by() -> Objects:
    """Two books, a mug and a ball at about the object's own size from its middle."""
    return [
        *_book(1.35, 0.5, 70, "8a2b20"),
        *_book(-0.6, 1.5, -15, "27508f"),
        *_mug(-1.35, -0.4),
        *_ball(0.5, -1.3),
    ]
