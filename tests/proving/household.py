"""Still more objects of the proving ground: low, open, tall and three-legged ones.

Units are scene units, z is up. An object stands at `TABLE_Z` and fits into a ball of radius 1.3.
"""

import geom
import numpy as np
from objects import TABLE_Z, Mesh, Objects, _box, _tube, _turned
from scenes import LIN, mix, obj, tex_noise, uvgrid


def _lathe(
    points: list[tuple[float, float]], turn: np.ndarray, at: tuple[float, float, float]
) -> Mesh:
    """A turned body whose axis is not upright."""
    curve = geom.spline(geom.polyline_rounded(points, 0.01, 6), kind="pchip")
    return geom.xf(geom.lathe(curve, 280, 200), turn, at)


def _ellipsoid(half: tuple[float, float, float], at: tuple[float, float, float]) -> Mesh:
    ball = geom.sphere(1.0)
    normals = ball["N"] / np.array(half)
    ball["V"] = ball["V"] * np.array(half) + np.array(at)
    ball["N"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return ball


def skillet() -> Objects:
    """A low pan of dark satin iron with a long handle, a polished rim and a blue enamel outside."""
    outside = [(1e-4, 0.0), (0.5, 0.0), (0.62, 0.2), (0.63, 0.22)]
    inside = [(0.63, 0.22), (0.6, 0.21), (0.49, 0.04), (1e-4, 0.04)]
    handle = _tube([(0.6, 0, 0.19), (0.8, 0.02, 0.24), (1.2, 0.05, 0.27)], 0.045, 0.5)
    return [
        obj("outside", _turned(outside, 0.03), type="gloss", base=LIN("17406b"), alpha=0.05),
        obj("inside", _turned(inside, 0.02), type="metal", preset="Cr", alpha=0.2),
        obj("handle", handle, type="metal", preset="Cr", alpha=0.06),
    ]


def cup() -> Objects:
    """A cup of satin copper, bright inside, with a handle of polished brass."""
    outside = [(1e-4, 0.0), (0.3, 0.0), (0.34, 0.05), (0.42, 0.68), (0.43, 0.7)]
    inside = [(0.43, 0.7), (0.405, 0.69), (0.32, 0.06), (1e-4, 0.05)]
    handle = _tube([(0.4, 0, 0.56), (0.66, 0, 0.52), (0.66, 0, 0.2), (0.36, 0, 0.14)], 0.035, 0.6)
    return [
        obj("outside", _turned(outside, 0.02), type="metal", preset="Cu", alpha=0.12),
        obj("inside", _turned(inside, 0.01), type="metal", preset="Al", alpha=0.18),
        obj("handle", handle, type="metal", preset="Au", alpha=0.06),
    ]


def camera() -> Objects:
    """A camera: leather body, polished top plate with dials, a black lens with coated glass."""
    u, v = uvgrid(512)
    grain = np.clip(0.5 + 1.5 * tex_noise(u * 40, v * 40, 8, 3), 0, 1)
    leather = mix(LIN("16130f"), LIN("3a2c20"), grain)
    turn, z = 20.0, TABLE_Z
    about = geom.rot("z", turn)
    lens = [(1e-4, 0.0), (0.3, 0.0), (0.3, 0.16), (0.26, 0.18), (0.26, 0.34), (0.22, 0.36)]
    glass = [(0.22, 0.0), (0.2, 0.02), (1e-4, 0.05)]
    forward = about @ geom.rot("x", 90)
    dial = [(1e-4, 0.0), (0.12, 0.0), (0.12, 0.09), (0.1, 0.1), (1e-4, 0.1)]
    chrome = {"type": "metal", "preset": "Cr", "alpha": 0.08}

    def placed(x: float, y: float, high: float) -> tuple[float, float, float]:
        at = about @ np.array([x, y, 0.0])
        return (float(at[0]), float(at[1]), z + high)

    return [
        obj(
            "body",
            _box((0.72, 0.24, 0.3), (0, 0, z + 0.3), turn, 0.05),
            type="diffuse",
            base=leather,
        ),
        obj("top", _box((0.71, 0.23, 0.1), (0, 0, z + 0.68), turn, 0.03), **chrome),
        obj(
            "lens",
            _lathe(lens, forward, placed(0, -0.22, 0.36)),
            type="gloss",
            base=LIN("0c0c0e"),
            alpha=0.08,
        ),
        obj(
            "glass",
            _lathe(glass, forward, placed(0, -0.5, 0.36)),
            type="gloss",
            base=LIN("1a1030"),
            alpha=0.01,
        ),
        obj("dial", _lathe(dial, np.eye(3), placed(0.45, 0, 0.77)), **chrome),
        obj(
            "shutter",
            _lathe(dial, np.eye(3), placed(-0.5, 0, 0.77)),
            type="gloss",
            base=LIN("0c0c0e"),
            alpha=0.05,
        ),
    ]


def stool() -> Objects:
    """A small stool: a red lacquered seat on three chrome legs; much ground shows below it."""
    seat = [(1e-4, 0.62), (0.5, 0.62), (0.56, 0.66), (0.56, 0.72), (0.5, 0.76), (1e-4, 0.75)]
    out = [obj("seat", _turned(seat, 0.03), type="gloss", base=LIN("9a1b14"), alpha=0.05)]
    for k in range(3):
        a = 0.4 + 2 * np.pi * k / 3
        c, s = float(np.cos(a)), float(np.sin(a))
        leg = _tube(
            [(0.35 * c, 0.35 * s, 0.63), (0.47 * c, 0.47 * s, 0.3), (0.6 * c, 0.6 * s, 0.0)], 0.045
        )
        foot = geom.sphere(0.06, (0.6 * c, 0.6 * s, TABLE_Z + 0.06))
        out.append(obj(f"leg{k}", leg, type="metal", preset="Cr", alpha=0.05))
        out.append(obj(f"foot{k}", foot, type="diffuse", base=LIN("151515")))
    return out


def bottle() -> Objects:
    """A square bottle of dark green glaze with a gold cap."""
    gold = {"type": "metal", "preset": "Au", "alpha": 0.05}
    cap = [(1e-4, 0.98), (0.17, 0.98), (0.19, 1.02), (0.19, 1.3), (0.16, 1.34), (1e-4, 1.35)]
    neck = [(1e-4, 0.86), (0.13, 0.86), (0.13, 1.0), (1e-4, 1.0)]
    return [
        obj(
            "body",
            _box((0.36, 0.24, 0.44), (0, 0, TABLE_Z + 0.44), 33, 0.07),
            type="glaze",
            base=LIN("0d3b2a"),
            alpha=0.04,
        ),
        obj("neck", _turned(neck), type="glaze", base=LIN("0d3b2a"), alpha=0.04),
        obj("cap", _turned(cap), **gold),
    ]


def mouse() -> Objects:
    """A computer mouse of black gloss with a chrome rim and a grey wheel: low and round."""
    turn = geom.rot("z", 35)
    top = geom.xf(_ellipsoid((0.72, 0.45, 0.36), (0, 0, 0.1)), turn, (0, 0, TABLE_Z))
    rim = geom.xf(_ellipsoid((0.75, 0.48, 0.1), (0, 0, 0.1)), turn, (0, 0, TABLE_Z))
    wheel = geom.xf(_ellipsoid((0.12, 0.05, 0.12), (0.36, 0, 0.36)), turn, (0, 0, TABLE_Z))
    return [
        obj("top", top, type="gloss", base=LIN("0e0e10"), alpha=0.03),
        obj("rim", rim, type="metal", preset="Cr", alpha=0.05),
        obj("wheel", wheel, type="diffuse", base=LIN("777777")),
    ]


def plate() -> Objects:
    """A glazed plate with a blue pattern and a gold rim, and a red glazed ball on it."""
    u, v = uvgrid(512)
    pattern = np.clip(tex_noise(u * 8, v * 3, 5, 11) * 4, 0, 1)
    white = mix(LIN("e4e1d8"), LIN("24478f"), pattern * (v > 0.45))
    dish = [
        (1e-4, 0.03),
        (0.42, 0.03),
        (0.52, 0.09),
        (0.84, 0.17),
        (0.86, 0.155),
        (0.5, 0.03),
        (0.46, 0.0),
        (1e-4, 0.0),
    ]
    rim = [(0.835, 0.172), (0.85, 0.182), (0.87, 0.165), (0.862, 0.15)]
    return [
        obj("dish", _turned(dish[::-1], 0.012), type="glaze", base=white, alpha=0.05),
        obj("rim", _turned(rim, 0.004), type="metal", preset="Au", alpha=0.06),
        obj(
            "apple",
            geom.sphere(0.24, (0.1, 0.05, TABLE_Z + 0.27)),
            type="glaze",
            base=LIN("9c1812"),
            alpha=0.05,
        ),
    ]
