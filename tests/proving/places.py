"""Tables, rooms and cameras of the proving ground.

Units are scene units, z is up, and an object fits into a ball of radius 1.3.
"""

import env
import numpy as np
from scenes import LIN, mix, tex_noise, uvgrid

LOWERED = np.array([0.0, 0.0, 0.1])  # of the cameras, towards the table


# ---- tables: (N, N, 3) linear reflectance
def planks(seed: int, n: int = 2048) -> np.ndarray:
    """Dark wooden planks with grain and gaps."""
    u, v = uvgrid(n)
    row = np.floor(v * 9)
    shift = np.random.default_rng(seed).uniform(0, 50, 9)[row.astype(int)]
    grain = tex_noise(u * 2 + shift, v * 26, 6, seed, 5)
    fine = tex_noise(u * 6 + shift, v * 160, 6, seed + 3, 3)
    wood = mix(LIN("4a2c17"), LIN("9c6b3d"), np.clip(0.5 + 0.8 * grain + 0.3 * fine, 0, 1))
    return wood * (1 - 0.8 * ((v * 9) % 1 < 0.025))[..., None]


def stone(seed: int, n: int = 2048) -> np.ndarray:
    """Speckled granite."""
    u, v = uvgrid(n)
    grain = tex_noise(u, v, 140, seed, 3)
    spots = tex_noise(u, v, 60, seed + 7, 2)
    grey = np.clip(0.35 + 0.5 * grain, 0.02, 0.9)[..., None] * np.array([1.0, 0.96, 0.9])
    return np.where((spots > 0.35)[..., None], 0.05, grey)


def gingham(seed: int, n: int = 2048) -> np.ndarray:
    """Blue and white checked cloth with a weave; a few stains tell the checks apart."""
    u, v = uvgrid(n)
    bands = (np.floor(u * 22) % 2) + (np.floor(v * 22) % 2)
    cloth = mix(LIN("f0eee8"), LIN("27508f"), bands / 2)
    weave = 1 + 0.12 * np.sin(u * n * 0.9) * np.sin(v * n * 0.9) + 0.1 * tex_noise(u, v, 90, seed)
    stain = np.clip(tex_noise(u, v, 5, seed + 4, 3) - 0.25, 0, 1)[..., None] * np.array(
        [0.3, 0.6, 0.9]
    )
    return np.clip(cloth * weave[..., None] * (1 - stain), 0.01, 0.9)


def linen(seed: int, n: int = 2048) -> np.ndarray:
    """White cloth, nearly plain: weak shade of folds and fine threads."""
    u, v = uvgrid(n)
    tone = (
        0.72
        + 0.05 * tex_noise(u, v, 9, seed, 4)
        + 0.08 * tex_noise(u * 4, v * 0.6, 60, seed + 2, 3)
    )
    return np.clip(tone, 0.05, 0.9)[..., None] * np.array([1.0, 0.985, 0.95])


def mosaic(seed: int, n: int = 2048) -> np.ndarray:
    """Small tiles of many colours with grout."""
    rng = np.random.default_rng(seed)
    u, v = uvgrid(n)
    k = 34
    colours = np.clip(rng.normal(0.35, 0.2, (k, k, 1)) + rng.normal(0, 0.08, (k, k, 3)), 0.02, 0.85)
    tile = colours[(v * k).astype(int), (u * k).astype(int)]
    grout = ((u * k) % 1 < 0.08) | ((v * k) % 1 < 0.08)
    speck = 1 + 0.15 * tex_noise(u, v, 200, seed + 1, 2)
    return np.where(grout[..., None], 0.5, tile) * speck[..., None]


def tablecloth(seed: int, n: int = 2048) -> np.ndarray:
    """Red and white checked cloth, narrow checks, with threads of unequal thickness."""
    u, v = uvgrid(n)
    bands = (np.floor(u * 34) % 2) + (np.floor(v * 34) % 2)
    cloth = mix(LIN("efe9e0"), LIN("9a1f2b"), bands / 2)
    threads = 1 + 0.08 * tex_noise(u * 8, v * 0.5, 80, seed, 2)
    threads += 0.08 * tex_noise(u * 0.5, v * 8, 80, seed + 1, 2)
    folds = 1 + 0.1 * tex_noise(u, v, 4, seed + 2, 2)
    return np.clip(cloth * (threads * folds)[..., None], 0.01, 0.9)


def tiles(seed: int, n: int = 2048) -> np.ndarray:
    """Equal beige tiles with weak marbling and dark grout."""
    u, v = uvgrid(n)
    marble = tex_noise(u, v, 18, seed, 5)
    tone = 0.5 + 0.07 * marble + 0.05 * tex_noise(u, v, 120, seed + 2, 2)
    colour = tone[..., None] * np.array([1.0, 0.9, 0.75])
    grout = ((u * 14) % 1 < 0.05) | ((v * 14) % 1 < 0.05)
    worn = 0.13 * (1 + 0.3 * tex_noise(u, v, 60, seed + 5, 2))
    return np.clip(np.where(grout[..., None], worn[..., None], colour), 0.01, 0.9)


def dots(seed: int, n: int = 2048) -> np.ndarray:
    """Green mat with equal white dots, woven from unequal threads."""
    u, v = uvgrid(n)
    x, y = (u * 26) % 1 - 0.5, (v * 26) % 1 - 0.5
    round_ = (x**2 + y**2 < 0.25**2)[..., None]
    mat = np.where(round_, LIN("f2f0e6"), LIN("2f6b4a"))
    weave = 1 + 0.1 * tex_noise(u, v, 110, seed, 2) + 0.06 * tex_noise(u, v, 12, seed + 1, 3)
    return np.clip(mat * weave[..., None], 0.01, 0.9)


def vinyl(seed: int, n: int = 2048) -> np.ndarray:
    """Printed black and white checks, all exactly equal."""
    u, v = uvgrid(n)
    dark = (np.floor(u * 24) + np.floor(v * 24)) % 2 > 0
    return np.where(dark[..., None], 0.06, 0.7) * np.ones(3)


def bricks(seed: int, n: int = 2048) -> np.ndarray:
    """Red bricks in a running bond; their tone differs a little."""
    rng = np.random.default_rng(seed)
    u, v = uvgrid(n)
    rows, columns = 28, 11
    row = np.floor(v * rows).astype(int)
    x = u * columns + 0.5 * (row % 2)
    tone = rng.normal(1.0, 0.08, (rows, columns + 1))[row, np.floor(x).astype(int)]
    rough = 1 + 0.12 * tex_noise(u, v, 130, seed + 1, 2)
    brick = (tone * rough)[..., None] * LIN("9a4a35")
    mortar = ((v * rows) % 1 < 0.13) | (x % 1 < 0.06)
    return np.clip(np.where(mortar[..., None], LIN("b5aca0"), brick), 0.01, 0.9)


def placemat(seed: int, n: int = 2048) -> np.ndarray:
    """The planks, with a plain, dark blue, round mat in the middle that lies flat."""
    u, v = uvgrid(n)
    on = (np.hypot(u - 0.5, v - 0.5) < 0.13)[..., None]
    return np.where(on, LIN("23304f"), planks(seed, n))


# ---- rooms
def _rooms() -> None:
    muted, vivid = env.MUTED, env.VIVID

    def office(w: int, h: int) -> np.ndarray:
        walls = [
            ((0.6, 0.6, 0.58), "blinds"),
            ((0.5, 0.5, 0.5), "shelf"),
            ((0.55, 0.52, 0.5), "door"),
            ((0.4, 0.45, 0.5), "window"),
        ]
        lamps = [
            (-0.8, 0.6, 0.6, 0.15, (9, 9, 9)),
            (0.8, 0.6, 0.6, 0.15, (9, 9, 9)),
            (-0.8, -0.7, 0.6, 0.15, (9, 9, 9)),
            (0.8, -0.7, 0.6, 0.15, (9, 9, 9)),
        ]
        return env.room(w, h, 71, walls, [0.7, 0.7, 0.7], [0.2, 0.22, 0.25], lamps, pal=muted)

    def attic(w: int, h: int) -> np.ndarray:
        walls = [
            ((0.6, 0.45, 0.3), "paint"),
            ((0.5, 0.4, 0.3), "door"),
            ((0.35, 0.25, 0.2), "window"),
            ((0.6, 0.5, 0.4), "shelf"),
        ]
        lamps = [(0.4, 0.2, 0.25, 0.25, (14, 11, 7))]
        return env.room(w, h, 207, walls, [0.45, 0.4, 0.35], [0.3, 0.2, 0.12], lamps, pal=vivid)

    def studio(w: int, h: int) -> np.ndarray:
        """A grey tent with three soft boxes: few features to place photos by."""
        d = env.dirs(w, h)
        out = (0.25 + 0.2 * (d[..., 2:] + 1)) * np.ones(3, np.float32)
        for axis, size, light in (
            ((1, 0.3, 0.5), 0.86, 7.0),
            ((-0.8, 0.7, 0.4), 0.9, 4.0),
            ((0.1, -1, 0.9), 0.93, 6.0),
        ):
            a = np.asarray(axis) / np.linalg.norm(axis)
            out = np.where((d @ a > size)[..., None], np.float32(light), out)
        return out.astype(np.float32)

    def square(w: int, h: int) -> np.ndarray:
        return env.outdoor(w, h, 47)

    env.EXTRA.update(office=office, attic=attic, studio=studio, square=square)


_rooms()


# ---- cameras: (eye, point looked at) of each photo
def _eye(radius: float, azimuth: float, elevation: float) -> np.ndarray:
    c = np.cos(elevation)
    return radius * np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])


def rings(
    n: int,
    rng: np.random.Generator,
    radius: float = 3.7,
    levels: tuple[float, ...] = (15, 32, 55),
    sweep: float = 2 * np.pi,
) -> list:
    """Some rings of photos held by hand."""
    counts = np.bincount(np.arange(n) % len(levels))
    out = []
    for level, m in zip(levels, counts, strict=True):
        start = rng.uniform(0, 2 * np.pi) if sweep > 6 else 0.0
        for k in range(m):
            azimuth = start + sweep * (k + rng.uniform(-0.25, 0.25)) / m
            elevation = np.deg2rad(level + rng.normal(0, 2.5))
            eye = _eye(radius + rng.normal(0, 0.2), azimuth, elevation) - LOWERED
            out.append((eye, np.array([0, 0, -0.15]) + rng.normal(0, 0.08, 3)))
    return out


def spiral(n: int, rng: np.random.Generator, radius: float = 3.5) -> list:
    """A walk round the object, twice, from low to high; the distance changes on the way."""
    out = []
    for k in range(n):
        t = (k + rng.uniform(-0.3, 0.3)) / n
        elevation = np.deg2rad(14 + 44 * t + rng.normal(0, 3))
        distance = radius + 0.5 * np.sin(5 * t) + rng.normal(0, 0.1)
        eye = _eye(distance, 4 * np.pi * t, elevation) - LOWERED
        out.append((eye, np.array([0, 0, -0.15]) + rng.normal(0, 0.1, 3)))
    return out


def three_quarters(n: int, rng: np.random.Generator) -> list:
    """Rings that leave a quarter out, as where an object stands in a corner."""
    return rings(n, rng, levels=(18, 40), sweep=1.5 * np.pi)
