"""An open pan, a vase with a narrow neck, a lamp and a globe.

Units are scene units, z is up. An object stands at `TABLE_Z` and fits into a ball of radius 1.3.
"""

import geom
import numpy as np
from objects import TABLE_Z, Objects, _box, _tube, _turned
from scenes import LIN, mix, obj, uvgrid


def saucepan() -> Objects:
    """An open saucepan of satin aluminium with a black handle."""
    outside = [(1e-4, 0.0), (0.5, 0.0), (0.56, 0.05), (0.57, 0.6), (0.6, 0.62)]
    inside = [(0.6, 0.62), (0.555, 0.61), (0.54, 0.07), (0.48, 0.03), (1e-4, 0.03)]
    handle = _tube([(0.54, 0, 0.5), (0.75, 0.02, 0.54), (1.2, 0.06, 0.58)], 0.05, 0.5)
    return [
        obj("outside", _turned(outside, 0.02), type="metal", preset="Al", alpha=0.08),
        obj("inside", _turned(inside, 0.02), type="metal", preset="Al", alpha=0.2),
        obj("handle", handle, type="gloss", base=LIN("131313"), alpha=0.1),
    ]


def vase() -> Objects:
    """A vase of white glaze with a blue band and a narrow, open neck."""
    u, v = uvgrid(512)
    band = (
        (np.abs(v - 0.35) < 0.04) | (np.abs(v - 0.55) < 0.02) | (np.sin(u * 50) * (v > 0.6) > 0.7)
    )
    cover = mix(LIN("ece9e2"), LIN("1d3f8f"), band.astype(float))
    profile = [(1e-4, 0.0), (0.3, 0.0), (0.36, 0.08), (0.52, 0.55), (0.3, 1.0), (0.17, 1.2)]
    profile += [(0.26, 1.36), (0.24, 1.37), (0.15, 1.2), (0.27, 0.98), (0.46, 0.5), (1e-4, 0.1)]
    return [obj("vase", _turned(profile, 0.02), type="glaze", base=cover, alpha=0.04)]


def lamp() -> Objects:
    """A desk lamp: a heavy black foot, a bent chrome arm, a green dome that is open below."""
    foot = [(1e-4, 0.0), (0.42, 0.0), (0.44, 0.03), (0.4, 0.09), (0.1, 0.12), (1e-4, 0.12)]
    arm = _tube([(0, 0, 0.1), (-0.22, 0, 0.6), (-0.1, 0, 1.15), (0.25, 0, 1.32)], 0.035)
    dome = [(0.36, -0.2), (0.35, -0.05), (0.2, 0.12), (0.08, 0.16), (1e-4, 0.16)]
    inner = [(1e-4, 0.13), (0.08, 0.13), (0.18, 0.1), (0.33, -0.06), (0.35, -0.2)]
    at = (0.3, 0.0, TABLE_Z + 1.2)
    turn = geom.rot("y", 20)
    shade = []
    for points in (dome, inner):
        curve = geom.spline(geom.polyline_rounded(points, 0.02, 6), kind="pchip")
        shade.append(geom.xf(geom.lathe(curve, 280, 200), turn, at))
    return [
        obj("foot", _turned(foot, 0.02), type="gloss", base=LIN("101010"), alpha=0.05),
        obj("arm", arm, type="metal", preset="Cr", alpha=0.05),
        obj("dome", shade[0], type="gloss", base=LIN("1c5a3a"), alpha=0.05),
        obj("inner", shade[1], type="gloss", base=LIN("e8e6e0"), alpha=0.2),
    ]


def globe() -> Objects:
    """A ball of red lacquer on a chrome rod, on a low, square, white foot."""
    ball = geom.sphere(0.45, (0, 0, TABLE_Z + 0.95))
    return [
        obj(
            "foot",
            _box((0.45, 0.45, 0.035), (0, 0, TABLE_Z + 0.035), 20),
            type="gloss",
            base=LIN("e6e2d8"),
            alpha=0.05,
        ),
        obj(
            "rod",
            _tube([(0, 0, 0.05), (0, 0, 0.3), (0, 0, 0.55)], 0.03),
            type="metal",
            preset="Cr",
            alpha=0.08,
        ),
        obj("ball", ball, type="gloss", base=LIN("8f1414"), alpha=0.04),
    ]
