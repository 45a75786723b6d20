"""Objects of the proving ground, made with the helpers of the capture generator.

Units are scene units, z is up. An object stands at `TABLE_Z` and fits into a ball of radius 1.3.
"""

from typing import Any

import geom
import numpy as np
from scenes import LIN, mix, obj, tex_noise, uvgrid

TABLE_Z = -0.55
Mesh = dict[str, np.ndarray]
Objects = list[dict[str, Any]]


def prism(bottom: np.ndarray, top: np.ndarray, z0: float, z1: float, n: int = 24) -> Mesh:
    """Flat walls between two convex polygons (K, 2), counterclockwise, with flat caps."""
    parts = []
    k = len(bottom)
    for i in range(k):
        a, b = np.r_[bottom[i], z0], np.r_[bottom[(i + 1) % k], z0]
        c, d = np.r_[top[(i + 1) % k], z1], np.r_[top[i], z1]
        parts.append(_quad(a, b, c, d, n))
    for ring, z, sign in ((bottom, z0, -1), (top, z1, 1)):
        for i in range(k):
            a, b = np.r_[ring[i], z], np.r_[ring[(i + 1) % k], z]
            o = np.r_[ring.mean(0), z]
            parts.append(
                _quad(o, a, b, (o + b) / 2, n) if sign > 0 else _quad(o, b, a, (o + a) / 2, n)
            )
    return geom.merge(parts)


def _quad(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray, n: int) -> Mesh:
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    u, v = u[..., None], v[..., None]
    p = (a * (1 - u) + b * u) * (1 - v) + (d * (1 - u) + c * u) * v
    normal = np.cross(b - a, d - a)
    normal = normal / np.linalg.norm(normal)
    i = np.arange(n - 1)
    s, t = np.meshgrid(i, i, indexing="ij")
    q = (s * n + t).ravel()
    faces = np.concatenate([np.stack([q, q + n, q + n + 1], 1), np.stack([q, q + n + 1, q + 1], 1)])
    points = p.reshape(-1, 3)
    return geom.clean(
        {
            "V": points,
            "F": faces,
            "N": np.tile(normal, (len(points), 1)),
            "UV": np.concatenate([u, v], -1).reshape(-1, 2),
        }
    )


def _polygon(k: int, radius: float, turn: float = 0.0) -> np.ndarray:
    a = turn + 2 * np.pi * np.arange(k) / k
    return radius * np.stack([np.cos(a), np.sin(a)], 1)


def _box(
    half: tuple[float, float, float],
    at: tuple[float, float, float],
    turn: float = 0.0,
    bevel: float = 0.02,
) -> Mesh:
    return geom.xf(geom.rounded_box(half, bevel), geom.rot("z", turn), at)


def _turned(
    points: list[tuple[float, float]], bevel: float = 0.02, n: int = 320, rib: Any = None
) -> Mesh:
    curve = geom.spline(geom.polyline_rounded(points, bevel, 6), kind="pchip")
    return geom.xf(geom.lathe(curve, n, 260, rib=rib), None, (0, 0, TABLE_Z))


def _tube(points: list[tuple[float, float, float]], radius: float, aspect: float = 1.0) -> Mesh:
    path = geom.spline([(x, y, z + TABLE_Z) for x, y, z in points])
    return geom.tube(path, lambda t: radius + 0 * t, 180, 48, aspect=aspect, up=(0, 1, 0))


# ---- objects
def mirror_box() -> Objects:
    """A polished chest with a dark lid knob: flat mirrors on all sides."""
    return [
        obj(
            "chest",
            _box((0.62, 0.42, 0.34), (0, 0, TABLE_Z + 0.34), 24),
            type="metal",
            preset="Cr",
            alpha=0.015,
        ),
        obj(
            "knob",
            geom.sphere(0.11, (0.05, 0, TABLE_Z + 0.78)),
            type="gloss",
            base=LIN("30160c"),
            alpha=0.06,
        ),
    ]


def toaster() -> Objects:
    """Brushed metal with two deep slots, plastic ends and a lever."""
    z, turn = TABLE_Z, -32
    metal = {"type": "metal", "preset": "Al", "alpha": 0.14}
    black = {"type": "gloss", "base": LIN("17171a"), "alpha": 0.12}

    def part(
        half: tuple[float, float, float], at: tuple[float, float, float], bevel: float = 0.02
    ) -> Mesh:
        spot = geom.rot("z", turn) @ np.asarray(at)
        return _box(half, (spot[0], spot[1], z + at[2]), turn, bevel)

    return [
        obj("front", part((0.6, 0.05, 0.36), (0, -0.33, 0.42)), **metal),
        obj("back", part((0.6, 0.05, 0.36), (0, 0.33, 0.42)), **metal),
        obj("middle", part((0.6, 0.055, 0.06), (0, 0, 0.71)), **metal),
        obj("floor", part((0.6, 0.33, 0.04), (0, 0, 0.10)), **black),
        obj("left", part((0.09, 0.38, 0.38), (-0.66, 0, 0.40), 0.05), **black),
        obj("right", part((0.09, 0.38, 0.38), (0.66, 0, 0.40), 0.05), **black),
        obj("lever", part((0.06, 0.09, 0.03), (0.79, 0, 0.55)), **black),
    ]


def gold_bowl() -> Objects:
    """An open bowl of satin gold with a foot."""
    profile = [
        (1e-4, 0.0),
        (0.34, 0.0),
        (0.34, 0.05),
        (0.16, 0.09),
        (0.16, 0.13),
        (0.45, 0.2),
        (0.72, 0.42),
        (0.82, 0.66),
        (0.79, 0.67),
        (0.69, 0.45),
        (0.43, 0.25),
        (1e-4, 0.19),
    ]
    return [obj("bowl", _turned(profile), type="metal", preset="Au", alpha=0.09)]


def tin() -> Objects:
    """A tin with a printed, varnished label and bare metal rims."""
    u, v = uvgrid(1024, 512)
    rng = np.random.default_rng(5)
    label = np.ones((*u.shape, 3)) * LIN("d9b13a")
    label[(v > 0.1) & (v < 0.2)] = LIN("8c1d18")
    label[(v > 0.78) & (v < 0.88)] = LIN("8c1d18")
    cells = rng.random((40, 160)) > 0.55
    text = (
        cells[(v * 40).astype(int), (u * 160).astype(int)]
        & (v > 0.28)
        & (v < 0.7)
        & ((v * 12) % 1 < 0.7)
    )
    label[text] = LIN("2b2014")
    disc = np.hypot(((u * 3) % 1 - 0.5) * 3.5, (v - 0.5) * 3.2) < 0.5
    label[disc] = LIN("f1e7d0")
    side = _turned([(0.55, 0.06), (0.55, 0.92)], 0.001)
    lid = _turned(
        [(1e-4, 0.90), (0.5, 0.90), (0.525, 0.96), (0.57, 0.96), (0.57, 0.92), (0.54, 0.92)], 0.012
    )
    foot = _turned([(0.54, 0.06), (0.57, 0.06), (0.57, 0.02), (0.52, 0.0), (1e-4, 0.0)], 0.012)
    return [
        obj("label", side, type="gloss", base=label, alpha=0.07),
        obj("lid", lid, type="metal", preset="Al", alpha=0.06),
        obj("foot", foot, type="metal", preset="Al", alpha=0.06),
    ]


def candlestick() -> Objects:
    """Thin brass arms with cups, on a turned foot."""
    brass = {"type": "metal", "preset": "Au", "alpha": 0.05}
    foot = _turned(
        [
            (1e-4, 0.0),
            (0.42, 0.0),
            (0.4, 0.05),
            (0.2, 0.09),
            (0.07, 0.2),
            (0.05, 0.6),
            (0.08, 0.64),
            (0.05, 0.68),
            (0.05, 0.98),
            (0.14, 1.02),
            (0.14, 1.12),
            (1e-4, 1.12),
        ]
    )
    out = [obj("foot", foot, **brass)]
    for k, side in enumerate((-1, 1)):
        arm = _tube(
            [
                (0.03 * side, 0, 0.64),
                (0.3 * side, 0, 0.5),
                (0.55 * side, 0, 0.62),
                (0.6 * side, 0, 0.88),
            ],
            0.028,
        )
        cup = _turned([(1e-4, 0.86), (0.07, 0.87), (0.13, 0.95), (0.13, 1.04), (1e-4, 1.04)])
        out += [
            obj(f"arm{k}", arm, **brass),
            obj(f"cup{k}", geom.xf(cup, None, (0.6 * side, 0, 0)), **brass),
        ]
    return out


def bear() -> Objects:
    """A figure of black gloss: soft shapes, crevices between them."""
    black = {"type": "gloss", "base": LIN("121214"), "alpha": 0.05}
    balls = [
        ("body", 0.42, (0, 0, 0.40)),
        ("head", 0.29, (0.05, 0, 0.98)),
        ("ear0", 0.1, (0.02, 0.2, 1.22)),
        ("ear1", 0.1, (0.02, -0.2, 1.22)),
        ("snout", 0.13, (0.3, 0, 0.92)),
        ("leg0", 0.17, (0.36, 0.24, 0.15)),
        ("leg1", 0.17, (0.36, -0.24, 0.15)),
        ("arm0", 0.13, (0.22, 0.38, 0.6)),
        ("arm1", 0.13, (0.22, -0.38, 0.6)),
    ]
    return [obj(n, geom.sphere(r, (x, y, z + TABLE_Z)), **black) for n, r, (x, y, z) in balls]


def pot() -> Objects:
    """Rough cast metal with ribs, and a lid with a wooden knob."""

    def ribs(th: np.ndarray, w: np.ndarray, r: np.ndarray, z: np.ndarray) -> np.ndarray:
        return r * (1 + 0.018 * np.cos(24 * th) * ((z > 0.12) & (z < 0.6)))

    body = _turned(
        [
            (1e-4, 0.0),
            (0.5, 0.0),
            (0.62, 0.08),
            (0.68, 0.35),
            (0.6, 0.64),
            (0.56, 0.66),
            (1e-4, 0.72),
        ],
        rib=ribs,
    )
    handles = [
        _tube(
            [
                (0.6 * s, 0.16, 0.5),
                (0.85 * s, 0.12, 0.54),
                (0.85 * s, -0.12, 0.54),
                (0.6 * s, -0.16, 0.5),
            ],
            0.045,
        )
        for s in (-1, 1)
    ]
    return [
        obj("body", body, type="metal", preset="W", alpha=0.28),
        *[
            obj(f"handle{k}", h, type="metal", preset="W", alpha=0.28)
            for k, h in enumerate(handles)
        ],
        obj("knob", geom.sphere(0.1, (0, 0, TABLE_Z + 0.8)), type="diffuse", base=LIN("7a4a22")),
    ]


def white_jug() -> Objects:
    """A white glazed jug with a handle."""
    white = {"type": "glaze", "base": LIN("e8e4da"), "alpha": 0.04}
    profile = [
        (1e-4, 0.0),
        (0.36, 0.0),
        (0.46, 0.1),
        (0.5, 0.32),
        (0.38, 0.66),
        (0.3, 0.86),
        (0.38, 1.08),
        (0.35, 1.09),
        (0.27, 0.87),
        (0.34, 0.66),
        (0.45, 0.32),
        (0.4, 0.1),
        (1e-4, 0.06),
    ]
    handle = _tube(
        [(-0.33, 0, 0.95), (-0.62, 0, 0.98), (-0.74, 0, 0.7), (-0.62, 0, 0.4), (-0.44, 0, 0.36)],
        0.05,
    )
    return [obj("jug", _turned(profile), **white), obj("handle", handle, **white)]


def ball_on_cushion() -> Objects:
    """A chrome ball that lies in a matte cushion."""

    def f(u: np.ndarray, w: np.ndarray) -> np.ndarray:
        a, b = 2 * np.pi * u, np.pi * w
        s = np.sign(np.cos(a)) * np.abs(np.cos(a)) ** 0.5
        t = np.sign(np.sin(a)) * np.abs(np.sin(a)) ** 0.5
        x, y = 0.8 * s * np.sin(b), 0.8 * t * np.sin(b)
        dent = 0.16 * np.exp(-(x * x + y * y) / 0.12)
        z = -0.2 * np.cos(b) * np.abs(np.sin(b) ** 0.2 + 0.2) + 0.22 - dent * (np.cos(b) < 0)
        return np.stack([x, y, z + TABLE_Z], -1)

    cushion = geom.param_surface(f, 300, 200)
    middle = np.array([0, 0, TABLE_Z + 0.2])
    if np.mean(np.sum((cushion["V"] - middle) * cushion["N"], 1)) < 0:
        cushion["N"], cushion["F"] = -cushion["N"], cushion["F"][:, ::-1].copy()
    u, v = uvgrid(512)
    stripes = mix(LIN("7d2030"), LIN("d8c49a"), ((u * 14) % 1 < 0.3).astype(float))
    stripes *= (1 + 0.25 * tex_noise(u * 8, v * 8, 16, 3, 3))[..., None]
    return [
        obj("cushion", cushion, type="diffuse", base=np.clip(stripes, 0.01, 0.9)),
        obj(
            "ball", geom.sphere(0.36, (0, 0, TABLE_Z + 0.62)), type="metal", preset="Cr", alpha=0.01
        ),
    ]


def pyramid() -> Objects:
    """A polished frustum with five leaning walls on a matte plinth."""
    top = prism(_polygon(5, 0.62, 0.3), _polygon(5, 0.34, 0.3), TABLE_Z + 0.16, TABLE_Z + 0.95)
    u, v = uvgrid(512)
    plinth = mix(LIN("3c5a46"), LIN("b9b08e"), np.clip(0.5 + tex_noise(u, v, 14, 8), 0, 1))
    return [
        obj(
            "plinth",
            _box((0.72, 0.72, 0.08), (0, 0, TABLE_Z + 0.08), 12),
            type="diffuse",
            base=plinth,
        ),
        obj("frustum", top, type="metal", preset="Cu", alpha=0.02),
    ]


def nut() -> Objects:
    """A large hexagonal nut of satin steel with a hole, and a copper ring that leans on it."""
    a, h, inner = np.linspace(0, 2 * np.pi, 181), 0.34, 0.36
    outer = 0.72 * np.cos(np.pi / 6) / np.cos(np.mod(a - 0.2, np.pi / 3) - np.pi / 6)
    walls = prism(_polygon(6, 0.72, 0.2), _polygon(6, 0.72, 0.2), 0.0, h)
    walls["F"] = walls["F"][np.abs(walls["N"][walls["F"]].mean(1)[:, 2]) < 0.5]  # without caps
    parts = [walls]
    for z, up in ((h, 1.0), (0.0, -1.0)):
        radius = inner + (outer[:, None] - inner) * np.linspace(0, 1, 12)
        parts.append(_sheet(a, radius, z, np.array([0, 0, up])))
    bore = _sheet(a, inner, np.linspace(0, h, 16), None)
    bore["N"] = -bore["V"] * [1, 1, 0] / inner
    steel = geom.xf(geom.merge([*parts, bore]), None, (0, 0, TABLE_Z))
    ring = geom.param_surface(
        lambda u, w: np.stack(
            [
                (0.2 + 0.05 * np.cos(2 * np.pi * w)) * np.cos(2 * np.pi * u),
                (0.2 + 0.05 * np.cos(2 * np.pi * w)) * np.sin(2 * np.pi * u),
                0.05 * np.sin(2 * np.pi * w),
            ],
            -1,
        ),
        320,
        90,
    )
    ring = geom.xf(ring, geom.rot("y", 62), (0.86, 0.1, TABLE_Z + 0.22))
    return [
        obj("nut", steel, type="metal", preset="Cr", alpha=0.1),
        obj("ring", ring, type="metal", preset="Cu", alpha=0.06),
    ]


def _sheet(angles: np.ndarray, radius: Any, z: Any, normal: np.ndarray | None) -> Mesh:
    """A grid over angles and one more parameter, which radius or height depends on."""
    x, y = np.cos(angles)[:, None] * radius, np.sin(angles)[:, None] * radius
    p = np.stack(np.broadcast_arrays(x, y, np.asarray(z, float)), -1)
    h, w = p.shape[:2]
    s, t = np.meshgrid(np.arange(h - 1), np.arange(w - 1), indexing="ij")
    q = (s * w + t).ravel()
    faces = np.concatenate([np.stack([q, q + w, q + w + 1], 1), np.stack([q, q + w + 1, q + 1], 1)])
    points = p.reshape(-1, 3)
    normals = np.tile(np.zeros(3) if normal is None else normal, (len(points), 1))
    return {"V": points, "F": faces, "N": normals, "UV": points[:, :2] * 0.4 + 0.5}


def lacquer_box() -> Objects:
    """A red lacquered box with a coarse gold band and a jade figure on top."""
    u, v = uvgrid(512)
    red = np.ones((*u.shape, 3)) * LIN("8f1512")
    red[np.abs(v - 0.5) < 0.09] = LIN("caa34a")
    petals = np.hypot((u * 5) % 1 - 0.5, (v - 0.5) * 5) < 0.32
    red[petals] = LIN("20100c")
    jade = {"type": "glaze", "base": LIN("5f9a70"), "alpha": 0.1}
    return [
        obj(
            "box",
            _box((0.66, 0.5, 0.26), (0, 0, TABLE_Z + 0.26), 40, 0.05),
            type="gloss",
            base=red,
            alpha=0.04,
        ),
        obj(
            "lid",
            _box((0.7, 0.54, 0.05), (0, 0, TABLE_Z + 0.58), 40, 0.03),
            type="gloss",
            base=LIN("8f1512"),
            alpha=0.04,
        ),
        obj("jade", geom.sphere(0.17, (0, 0, TABLE_Z + 0.8)), **jade),
        obj("jade_top", geom.sphere(0.1, (0.03, 0.02, TABLE_Z + 1.02)), **jade),
    ]
