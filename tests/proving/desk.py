"""Objects with large flat panes, thin bands, bent tubes and separate parts.

Units are scene units, z is up. An object stands at `TABLE_Z` and fits into a ball of radius 1.3.
"""

import geom
import numpy as np
from household import _ellipsoid, _lathe
from objects import TABLE_Z, Objects, _box, _tube, _turned
from scenes import LIN, mix, obj, uvgrid

CHROME = {"type": "metal", "preset": "Cr", "alpha": 0.04}
BLACK = {"type": "gloss", "base": LIN("0e0e10"), "alpha": 0.05}


def screen() -> Objects:
    """A flat screen of black glass that leans back, on a satin metal stand."""
    lean = geom.rot("z", 25) @ geom.rot("x", -12)
    pane = geom.xf(geom.rounded_box((0.8, 0.035, 0.48), 0.015), lean, (0, 0, TABLE_Z + 0.78))
    behind = lean @ [0, 0.05, 0] + [0, 0, TABLE_Z + 0.78]
    back = geom.xf(geom.rounded_box((0.78, 0.03, 0.46), 0.015), lean, behind)
    turn = geom.rot("z", 25)
    below = turn @ [0, 0.13, 0] + [0, 0, TABLE_Z + 0.34]
    neck = geom.xf(geom.rounded_box((0.09, 0.025, 0.32), 0.015), turn, below)
    foot = _box((0.34, 0.26, 0.025), (0, 0, TABLE_Z + 0.025), 25)
    satin = {"type": "metal", "preset": "Al", "alpha": 0.15}
    return [
        obj("pane", pane, type="gloss", base=LIN("050507"), alpha=0.01),
        obj("back", back, **satin),
        obj("neck", neck, **satin),
        obj("foot", foot, **satin),
    ]


def headphones() -> Objects:
    """Headphones that stand on their cups: a thin bent band, white lacquer, copper rings."""
    band = _tube(
        [(-0.55, 0, 0.4), (-0.5, 0, 0.95), (0, 0, 1.25), (0.5, 0, 0.95), (0.55, 0, 0.4)], 0.035, 2.2
    )
    out = [obj("band", band, **CHROME)]
    for name, side in (("left", -1.0), ("right", 1.0)):
        outward = geom.rot("y", 90 * side)
        shell = [(1e-4, 0.14), (0.24, 0.13), (0.32, 0.06), (0.33, 0.0), (1e-4, 0.0)]
        pad = [(1e-4, 0.0), (0.3, 0.0), (0.33, -0.06), (0.28, -0.14), (1e-4, -0.12)]
        ring = [(0.325, 0.0), (0.345, 0.01), (0.345, 0.03), (0.32, 0.04)]
        at = (0.55 * side, 0.0, TABLE_Z + 0.345)
        white = {"type": "gloss", "base": LIN("e9e6df"), "alpha": 0.04}
        out.append(obj(f"shell_{name}", _lathe(shell[::-1], outward, at), **white))
        out.append(obj(f"pad_{name}", _lathe(pad, outward, at), type="diffuse", base=LIN("2a2422")))
        copper = _lathe(ring, outward, at)
        out.append(obj(f"ring_{name}", copper, type="metal", preset="Cu", alpha=0.06))
    return out


def clock() -> Objects:
    """An alarm clock: a brass drum that stands upright, a white face, two bells, two legs."""
    forward = geom.rot("z", -20) @ geom.rot("x", 90)
    drum = [(1e-4, -0.18), (0.44, -0.18), (0.46, -0.16), (0.46, 0.16), (0.44, 0.18), (0.4, 0.15)]
    face = [(0.41, 0.14), (0.2, 0.14), (1e-4, 0.14)]
    at = (0.0, 0.0, TABLE_Z + 0.6)
    u, v = uvgrid(512)
    marks = (np.abs(((u * 12 + 0.5) % 1) - 0.5) < 0.06) & (v > 0.1) & (v < 0.3)
    dial = mix(LIN("f3efe4"), LIN("111111"), marks.astype(float))
    brass = {"type": "metal", "preset": "Au", "alpha": 0.1}
    out = [
        obj("drum", _lathe(drum, forward, at), **brass),
        obj("face", _lathe(face, forward, at), type="gloss", base=dial, alpha=0.08),
    ]
    across = geom.rot("z", -20) @ np.array([1.0, 0, 0])
    for name, side in (("left", -1.0), ("right", 1.0)):
        bell = at + 0.24 * side * across + np.array([0, 0, 0.52])
        out.append(obj(f"bell_{name}", _ellipsoid((0.17, 0.17, 0.13), tuple(bell)), **CHROME))
        top, low = 0.3 * side * across, 0.4 * side * across
        leg = _tube([(top[0], top[1], 0.3), (low[0], low[1], 0.03)], 0.035)
        out.append(obj(f"leg_{name}", leg, **BLACK))
    return out


def tap() -> Objects:
    """A water tap of chrome on a thick, round base, with a bent spout and a flat lever."""
    base = [
        (1e-4, 0.0),
        (0.3, 0.0),
        (0.31, 0.03),
        (0.2, 0.07),
        (0.17, 0.1),
        (0.16, 0.75),
        (1e-4, 0.78),
    ]
    spout = _tube(
        [(0, 0, 0.55), (0, 0, 1.0), (0.3, 0.1, 1.2), (0.6, 0.2, 1.1), (0.65, 0.22, 0.85)], 0.075
    )
    lever = geom.xf(
        geom.rounded_box((0.26, 0.06, 0.025), 0.015),
        geom.rot("z", 200),
        (-0.3, -0.1, TABLE_Z + 0.8),
    )
    return [
        obj("base", _turned(base, 0.015), **CHROME),
        obj("spout", spout, **CHROME),
        obj("lever", lever, **CHROME),
    ]


def chessmen() -> Objects:
    """Three chessmen side by side: black gloss, ivory and polished brass, of unequal height."""
    pawn = [
        (1e-4, 0),
        (0.24, 0),
        (0.24, 0.06),
        (0.13, 0.14),
        (0.08, 0.38),
        (0.14, 0.42),
        (0.08, 0.45),
    ]
    pawn += [(0.14, 0.55), (0.12, 0.66), (1e-4, 0.7)]
    king = [(1e-4, 0), (0.28, 0), (0.28, 0.07), (0.16, 0.16), (0.1, 0.6), (0.18, 0.66), (0.11, 0.7)]
    king += [(0.17, 0.98), (0.1, 1.02), (0.05, 1.12), (1e-4, 1.14)]
    looks = (
        ("black", king, (-0.38, 0.12), BLACK),
        ("ivory", pawn, (0.25, 0.35), {"type": "gloss", "base": LIN("e8dcc0"), "alpha": 0.06}),
        ("brass", pawn, (0.3, -0.35), {"type": "metal", "preset": "Au", "alpha": 0.06}),
    )
    return [
        obj(name, geom.xf(_turned(profile, 0.015), None, (x, y, 0)), **look)
        for name, profile, (x, y), look in looks
    ]


def spoon() -> Objects:
    """A large steel spoon that lies flat: low, thin, a mirror with a hollow."""
    path = [(-1.1, 0.1, 0.05), (-0.5, 0.04, 0.11), (0.1, 0.0, 0.08), (0.35, 0, 0.1)]
    handle = _tube(path, 0.035, 2.0)
    bowl = _ellipsoid((0.42, 0.28, 0.13), (0.65, 0, TABLE_Z + 0.13))
    keep = bowl["V"][:, 2] < TABLE_Z + 0.15
    faces = bowl["F"][keep[bowl["F"]].all(1)]
    outer = geom.clean({**bowl, "F": faces})
    inner = {key: value.copy() for key, value in outer.items()}
    centre = np.array([0.65, 0, TABLE_Z + 0.13])
    inner["V"] = centre + (inner["V"] - centre) * np.array([0.95, 0.93, 0.85])
    inner["F"], inner["N"] = inner["F"][:, ::-1], -inner["N"]
    return [
        obj("handle", handle, **CHROME),
        obj("bowl", outer, **CHROME),
        obj("hollow", inner, **CHROME),
    ]
