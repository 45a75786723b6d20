"""More objects of the proving ground: everyday things.

Units are scene units, z is up. An object stands at `TABLE_Z` and fits into a ball of radius 1.3.
"""

import geom
import numpy as np
from objects import TABLE_Z, Objects, _box, _polygon, _tube, _turned, prism
from scenes import LIN, mix, obj, tex_noise, uvgrid


def teapot() -> Objects:
    """A dark blue glazed teapot with a spout, a handle and a lid."""
    u, v = uvgrid(512)
    blue = mix(LIN("14264f"), LIN("35548c"), np.clip(0.5 + tex_noise(u * 3, v, 6, 4, 3), 0, 1))
    glaze = {"type": "glaze", "alpha": 0.05}
    body = [
        (1e-4, 0.0),
        (0.34, 0.0),
        (0.36, 0.04),
        (0.52, 0.2),
        (0.56, 0.38),
        (0.46, 0.6),
        (0.26, 0.7),
        (1e-4, 0.71),
    ]
    lid = [(1e-4, 0.7), (0.25, 0.7), (0.22, 0.75), (0.05, 0.8), (1e-4, 0.8)]
    spout = _tube([(0.42, 0, 0.3), (0.66, 0, 0.36), (0.78, 0, 0.56), (0.92, 0, 0.68)], 0.075)
    handle = _tube(
        [(-0.42, 0, 0.58), (-0.72, 0, 0.66), (-0.86, 0, 0.44), (-0.7, 0, 0.22), (-0.46, 0, 0.2)],
        0.045,
    )
    return [
        obj("body", _turned(body), base=blue, **glaze),
        obj("lid", _turned(lid), base=LIN("1b2f5c"), **glaze),
        obj("knob", geom.sphere(0.07, (0, 0, TABLE_Z + 0.85)), base=LIN("c9a24b"), **glaze),
        obj("spout", spout, base=LIN("1b2f5c"), **glaze),
        obj("handle", handle, base=LIN("1b2f5c"), **glaze),
    ]


def trophy() -> Objects:
    """A polished silver cup with two handles on a black polished plinth."""
    silver = {"type": "metal", "preset": "Ag", "alpha": 0.04}
    z = 0.24
    cup = [
        (1e-4, z),
        (0.26, z),
        (0.25, z + 0.04),
        (0.07, z + 0.12),
        (0.06, z + 0.22),
        (0.14, z + 0.3),
        (0.34, z + 0.5),
        (0.4, z + 0.9),
        (0.37, z + 0.91),
        (0.31, z + 0.52),
        (1e-4, z + 0.36),
    ]
    out = [
        obj(
            "plinth",
            _box((0.46, 0.46, 0.12), (0, 0, TABLE_Z + 0.12), 20, 0.015),
            type="gloss",
            base=LIN("101012"),
            alpha=0.03,
        ),
        obj("cup", _turned(cup), **silver),
    ]
    for k, s in enumerate((-1, 1)):
        arm = [
            (0.36 * s, 0, z + 0.8),
            (0.58 * s, 0, z + 0.86),
            (0.62 * s, 0, z + 0.62),
            (0.32 * s, 0, z + 0.52),
        ]
        out.append(obj(f"arm{k}", _tube(arm, 0.03), **silver))
    return out


def phone() -> Objects:
    """A slab of black glass in a steel frame, on a block of varnished wood."""
    u, v = uvgrid(512)
    wood = mix(LIN("5d3a1e"), LIN("a8743f"), np.clip(0.5 + tex_noise(u * 1.5, v * 14, 6, 9), 0, 1))
    return [
        obj(
            "block",
            _box((0.8, 0.5, 0.2), (0, 0, TABLE_Z + 0.2), 15, 0.03),
            type="gloss",
            base=wood,
            alpha=0.16,
        ),
        obj(
            "frame",
            _box((0.68, 0.36, 0.05), (0.02, 0, TABLE_Z + 0.45), 28, 0.02),
            type="metal",
            preset="Cr",
            alpha=0.12,
        ),
        obj(
            "glass",
            _box((0.65, 0.33, 0.02), (0.02, 0, TABLE_Z + 0.5), 28, 0.01),
            type="gloss",
            base=LIN("08080a"),
            alpha=0.015,
        ),
    ]


def car() -> Objects:
    """A toy car: red lacquer, dark windows, matte tyres with chrome hubs."""
    red = {"type": "gloss", "base": LIN("a3140f"), "alpha": 0.03}
    out = [
        obj("body", _box((0.95, 0.4, 0.14), (0, 0, TABLE_Z + 0.3), 30, 0.11), **red),
    ]
    cabin = geom.sphere(1.0)
    scale, turn = np.array([0.5, 0.34, 0.26]), geom.rot("z", 30)
    normals = cabin["N"] / scale
    cabin["V"] = (cabin["V"] * scale) @ turn.T + [0, 0, TABLE_Z + 0.44]
    cabin["N"] = (normals / np.linalg.norm(normals, axis=1, keepdims=True)) @ turn.T
    out.append(obj("cabin", cabin, type="gloss", base=LIN("111418"), alpha=0.02))
    wheel = [(1e-4, -0.07), (0.16, -0.07), (0.19, -0.04), (0.19, 0.04), (0.16, 0.07), (1e-4, 0.07)]
    for k, (x, y) in enumerate([(0.56, 0.4), (0.56, -0.4), (-0.56, 0.4), (-0.56, -0.4)]):
        at = geom.rot("z", 30) @ np.array([x, y, 0.19])
        tyre = geom.lathe(
            geom.spline(geom.polyline_rounded(wheel, 0.02, 6), kind="pchip"), 200, 160
        )
        lie = geom.rot("z", 30) @ geom.rot("x", 90)
        centre = at + np.array([0, 0, TABLE_Z])
        out.append(obj(f"tyre{k}", geom.xf(tyre, lie, centre), type="diffuse", base=LIN("202022")))
        hub = centre + geom.rot("z", 30) @ np.array([0, 0.05 * np.sign(y), 0])
        out.append(
            obj(f"hub{k}", geom.sphere(0.085, tuple(hub)), type="metal", preset="Cr", alpha=0.04)
        )
    return out


def holder() -> Objects:
    """A hexagonal pencil holder of satin steel, closed, with a red band of lacquer."""
    foot, band = _polygon(6, 0.5, 0.35), _polygon(6, 0.505, 0.35)
    z = TABLE_Z
    return [
        obj("holder", prism(foot, foot, z, z + 1.0), type="metal", preset="Cr", alpha=0.09),
        obj(
            "band",
            prism(band, band, z + 0.62, z + 0.78),
            type="gloss",
            base=LIN("8c1512"),
            alpha=0.05,
        ),
    ]


def watch() -> Objects:
    """A steel watch that stands on the ring of its bracelet: thin, with a hole, glass on top."""
    turn = geom.rot("z", 25)
    bracelet = geom.param_surface(
        lambda u, w: np.stack(
            [
                (0.5 + 0.035 * np.cos(2 * np.pi * w)) * np.cos(2 * np.pi * u),
                0.2 * np.sin(2 * np.pi * w),
                (0.5 + 0.035 * np.cos(2 * np.pi * w)) * np.sin(2 * np.pi * u),
            ],
            -1,
        ),
        320,
        90,
    )
    case = [(1e-4, -0.06), (0.33, -0.06), (0.36, -0.02), (0.36, 0.05), (0.32, 0.08), (1e-4, 0.08)]
    dial = [(1e-4, 0.0), (0.27, 0.0), (0.27, 0.02), (1e-4, 0.02)]
    lathe = [
        geom.lathe(geom.spline(geom.polyline_rounded(p, 0.01, 6), kind="pchip"), 320, 200)
        for p in (case, dial)
    ]
    high = TABLE_Z + 0.53
    return [
        obj(
            "bracelet", geom.xf(bracelet, turn, (0, 0, high)), type="metal", preset="Cr", alpha=0.1
        ),
        obj(
            "case",
            geom.xf(lathe[0], turn, (0, 0, high + 0.53)),
            type="metal",
            preset="Au",
            alpha=0.05,
        ),
        obj(
            "dial",
            geom.xf(lathe[1], turn, (0, 0, high + 0.6)),
            type="gloss",
            base=LIN("10243f"),
            alpha=0.01,
        ),
    ]


def helmet() -> Objects:
    """A white lacquered helmet with a blue stripe and a dark visor."""
    u, _ = uvgrid(512)
    shell = mix(LIN("d8d6d0"), LIN("1c3f8f"), (np.abs(np.mod(u, 0.5) - 0.25) < 0.03) * 1.0)
    dome = _turned(
        [(0.5, 0.0), (0.62, 0.1), (0.72, 0.4), (0.66, 0.75), (0.42, 1.02), (1e-4, 1.12)], 0.1
    )
    floor = _turned([(1e-4, 0.02), (0.45, 0.02), (0.5, 0.0)], 0.005)
    visor = geom.sphere(1.0)
    scale = np.array([0.62, 0.56, 0.22])
    normals = visor["N"] / scale
    visor["V"] = visor["V"] * scale + [0.16, 0, TABLE_Z + 0.52]
    visor["N"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return [
        obj("shell", dome, type="gloss", base=shell, alpha=0.03),
        obj("floor", floor, type="diffuse", base=LIN("303030")),
        obj("visor", visor, type="gloss", base=LIN("0b0d10"), alpha=0.015),
    ]
