"""Objects from a shelf: loops, knots, stacks, four legs and printed gloss.

Units are scene units, z is up. An object stands at `TABLE_Z` and fits into a ball of radius 1.3.
"""

import geom
import numpy as np
from desk import BLACK, CHROME
from household import _ellipsoid, _lathe
from objects import TABLE_Z, Objects, _box, _tube, _turned
from scenes import LIN, mix, obj, tex_noise, uvgrid


def watering_can() -> Objects:
    """A can of satin zinc with a long spout, a rose of copper and a large round handle."""
    zinc = {"type": "metal", "preset": "Al", "alpha": 0.2}
    body = [
        (1e-4, 0.0), (0.44, 0.0), (0.46, 0.03), (0.4, 0.72), (0.36, 0.73),
        (0.41, 0.06), (1e-4, 0.05),
    ]  # fmt: skip
    spout = _tube([(0.4, 0, 0.16), (0.62, 0, 0.3), (0.8, 0, 0.62), (0.94, 0, 0.86)], 0.055)
    handle = _tube(
        [(-0.44, 0, 0.14), (-0.84, 0, 0.3), (-0.86, 0, 0.72), (-0.5, 0, 0.98), (0, 0, 0.98),
         (0.3, 0, 0.74)],
        0.035,
    )  # fmt: skip
    tilt = geom.rot("y", 32)
    rose = _lathe(
        [(1e-4, 0.0), (0.05, 0.0), (0.14, 0.12), (0.13, 0.13), (1e-4, 0.15)],
        tilt,
        (0.92, 0, TABLE_Z + 0.84),
    )
    return [
        obj("body", _turned(body), **zinc),
        obj("spout", spout, **zinc),
        obj("handle", handle, **zinc),
        obj("rose", rose, type="metal", preset="Cu", alpha=0.1),
    ]


def knot() -> Objects:
    """A knotted tube of polished copper on a slab of rough slate."""

    def path(t: np.ndarray) -> np.ndarray:
        a = 2 * np.pi * np.asarray(t)
        r = 0.42 + 0.19 * np.cos(3 * a)
        return np.stack(
            [r * np.cos(2 * a), 0.22 * np.sin(3 * a), TABLE_Z + 0.81 + r * np.sin(2 * a)], -1
        )

    tube = geom.tube(path, lambda t: 0.085 + 0 * t, 520, 64, up=(0, 1, 0.02), cap=False)
    u, v = uvgrid(512)
    slate = mix(LIN("2c2f33"), LIN("4a4d50"), np.clip(0.5 + tex_noise(u, v, 12, 2, 4), 0, 1))
    return [
        obj("tube", tube, type="metal", preset="Cu", alpha=0.08),
        obj(
            "slab", _box((0.5, 0.34, 0.06), (0, 0, TABLE_Z + 0.06), 15), type="diffuse", base=slate
        ),
    ]


def boxes() -> Objects:
    """Two printed, varnished boxes on each other, turned, and a silver ball on top."""
    u, v = uvgrid(512)
    bands = np.floor(v * 6) % 2
    first = mix(LIN("1d5c63"), LIN("e8dfc8"), bands * (np.abs(u - 0.5) < 0.36))
    spots = (np.hypot((u * 4) % 1 - 0.5, (v * 4) % 1 - 0.5) < 0.3).astype(float)
    second = mix(LIN("c8502e"), LIN("f1d9a0"), spots)
    return [
        obj(
            "lower", _box((0.62, 0.45, 0.2), (0, 0, TABLE_Z + 0.2), 12),
            type="glaze", base=first, alpha=0.08,
        ),
        obj(
            "upper", _box((0.4, 0.34, 0.17), (0.04, 0.03, TABLE_Z + 0.57), 47),
            type="glaze", base=second, alpha=0.05,
        ),
        obj(
            "ball", geom.sphere(0.15, (0.02, 0, TABLE_Z + 0.89)),
            type="metal", preset="Ag", alpha=0.05,
        ),
    ]  # fmt: skip


def dog() -> Objects:
    """A dog of white glaze: four legs, a bent tail, ears, a black nose and a gold collar."""
    white = {"type": "glaze", "base": LIN("e6e1d6"), "alpha": 0.06}
    z = TABLE_Z
    parts = [("trunk", _ellipsoid((0.52, 0.25, 0.26), (0, 0, z + 0.56)))]
    for k, (x, y) in enumerate([(0.34, 0.13), (0.34, -0.13), (-0.34, 0.13), (-0.34, -0.13)]):
        leg = [(1e-4, 0.0), (0.1, 0.0), (0.1, 0.05), (0.07, 0.1), (0.09, 0.5), (1e-4, 0.55)]
        parts.append((f"leg{k}", _lathe(leg, np.eye(3), (x, y, z))))
    parts.append(("neck", _tube([(0.36, 0, 0.6), (0.46, 0, 0.78), (0.52, 0, 0.95)], 0.14)))
    parts.append(("head", _ellipsoid((0.2, 0.16, 0.17), (0.56, 0, z + 1.0))))
    parts.append(("muzzle", _ellipsoid((0.17, 0.09, 0.09), (0.74, 0, z + 0.94))))
    for k, y in enumerate((0.15, -0.15)):
        parts.append((f"ear{k}", _ellipsoid((0.07, 0.035, 0.15), (0.5, y, z + 1.0))))
    parts.append(("tail", _tube([(-0.48, 0, 0.6), (-0.66, 0, 0.72), (-0.72, 0, 0.95)], 0.045)))
    out = [obj(name, mesh, **white) for name, mesh in parts]
    out.append(obj("nose", geom.sphere(0.05, (0.9, 0, z + 0.97)), **BLACK))
    collar = _lathe(
        [(0.14, -0.035), (0.165, -0.03), (0.165, 0.03), (0.14, 0.035)],
        geom.rot("y", 25),
        (0.46, 0, z + 0.79),
    )
    out.append(obj("collar", collar, type="metal", preset="Au", alpha=0.08))
    return out


def speaker() -> Objects:
    """An upright box of black lacquer: two matte cones in chrome rings on its front."""
    turn = geom.rot("z", 30)
    body = _box((0.34, 0.3, 0.62), (0, 0, TABLE_Z + 0.62), 30)
    out = [obj("body", body, **BLACK)]
    forward = turn @ geom.rot("x", 90)
    for name, z, r in (("woofer", 0.42, 0.24), ("tweeter", 0.94, 0.13)):
        at = turn @ [0, -0.3, 0] + [0, 0, TABLE_Z + z]
        cone = [(r * 0.3, 0.012), (r * 0.8, 0.012), (r, 0.035)]
        cap = [(1e-4, 0.05), (r * 0.2, 0.04), (r * 0.3, 0.012)]
        ring = [(r, 0.0), (r, 0.035), (r + 0.03, 0.045), (r + 0.05, 0.0)]
        grey = {"type": "diffuse", "base": LIN("4b4a48")}
        out.append(obj(f"{name}_cone", _lathe(cone[::-1], forward, at), **grey))
        out.append(obj(f"{name}_cap", _lathe(cap[::-1], forward, at), **BLACK))
        out.append(obj(f"{name}_ring", _lathe(ring[::-1], forward, at), **CHROME))
    return out


def radio() -> Objects:
    """A low radio of cream plastic: a brown cloth front, a gold dial and a bent chrome handle."""
    u, v = uvgrid(512)
    weave = 0.5 + 0.5 * np.sin(u * 300) * np.sin(v * 160)
    cloth = mix(LIN("4a2f1c"), LIN("87643f"), weave)
    turn = geom.rot("z", -25)
    cream = {"type": "gloss", "base": LIN("d9c9a3"), "alpha": 0.1}
    front = turn @ [-0.2, -0.235, 0] + [0, 0, TABLE_Z + 0.3]
    dial = turn @ [0.42, -0.23, 0] + [0, 0, TABLE_Z + 0.36]
    rim = [(1e-4, 0.05), (0.14, 0.045), (0.15, 0.0)]
    arc = [(-0.5, 0, 0.55), (-0.46, 0, 0.78), (0, 0, 0.88), (0.46, 0, 0.78), (0.5, 0, 0.55)]
    return [
        obj("body", _box((0.72, 0.23, 0.29), (0, 0, TABLE_Z + 0.29), -25, 0.06), **cream),
        obj("front", geom.xf(geom.rounded_box((0.4, 0.015, 0.21), 0.01), turn, front),
            type="diffuse", base=cloth),
        obj("dial", _lathe(rim[::-1], turn @ geom.rot("x", 90), dial),
            type="metal", preset="Au", alpha=0.12),
        obj("handle", geom.xf(_tube(arc, 0.03), turn), **CHROME),
    ]  # fmt: skip
