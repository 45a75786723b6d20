"""The captures: some for choosing limits, the others for checking only."""

from collections.abc import Callable
from dataclasses import dataclass

import clutter as c
import desk as d
import habits as b
import household as h
import kitchen as k
import more_objects as m
import numpy as np
import objects as o
import places as p
import printed as w
import shelf as s
from capture import tex_newspaper


@dataclass(frozen=True)
class Recipe:
    """One capture.

    Args:
        checking: whether the capture is for checking only; no limit may be chosen on it.
        lens: (k1, k2) of OpenCV's radial distortion.
        focal: in millimetres for a sensor 36 mm wide.
        drift: standard deviation of the photos' exposure, in stops; tint: of their white balance,
            each colour by itself.
        shake: longest motion blur, in pixels.
        noise: standard deviation of the noise at full scale, linear.
        inside: (x, y) where the object stands in a room of 5.2 by 4.4 metres, metres from its
            middle; without it, the room is infinitely far away.
        someone: whether objects mirror someone who holds the camera; only `inside` a room.
        beside: what else stands on the table.
        varnish: roughness (GGX alpha) of a coat of varnish on the table; without it, it is matte.
    """

    objects: Callable[[], o.Objects]
    table: Callable[[int], np.ndarray]
    room: str
    cameras: Callable[[int, np.random.Generator], list[tuple[np.ndarray, np.ndarray]]]
    seed: int
    checking: bool = False
    size: tuple[int, int] = (640, 480)
    photos: int = 32
    lens: tuple[float, float] = (0.0, 0.0)
    focal: float = 35.0
    drift: float = 0.0
    tint: float = 0.0
    shake: float = 0.0
    noise: float = 1e-3
    inside: tuple[float, float] | None = None
    varnish: float | None = None
    beside: Callable[[], o.Objects] | None = None
    someone: bool = False


def papers(seed: int) -> np.ndarray:
    """Newspapers on a wooden table, the generator's own."""
    return tex_newspaper(seed=seed)


PHONE = {"lens": (0.04, -0.03), "focal": 26.0, "drift": 0.06, "shake": 1.2, "noise": 2e-3}
UPRIGHT = (480, 640)
HELD = {"checking": True, "someone": True}  # the camera, by someone whom the object mirrors

RECIPES = {
    "chest": Recipe(o.mirror_box, p.planks, "office", p.rings, seed=3),
    "bowl": Recipe(o.gold_bowl, p.stone, "square", p.spiral, seed=5, lens=(-0.06, 0.02)),
    "tin": Recipe(o.tin, p.gingham, "attic", p.spiral, seed=7, size=UPRIGHT, **PHONE),
    "bear": Recipe(o.bear, p.mosaic, "office", p.rings, seed=9),
    "pot": Recipe(o.pot, papers, "studio", p.rings, seed=11, drift=0.05),
    "pyramid": Recipe(o.pyramid, p.stone, "attic", p.spiral, seed=13),
    "pots": Recipe(o.pot, p.tablecloth, "room_b", p.rings, seed=27),
    "ingot": Recipe(o.gold_bowl, p.tiles, "office", p.spiral, seed=29, drift=0.05),
    "idol": Recipe(o.bear, p.dots, "square", p.rings, seed=31),
    "toaster": Recipe(o.toaster, p.gingham, "room_b", p.rings, seed=15, checking=True),
    "jug": Recipe(o.white_jug, p.linen, "office", p.spiral, seed=17, checking=True),
    "cushion": Recipe(o.ball_on_cushion, p.mosaic, "square", p.rings, seed=19, checking=True),
    "nut": Recipe(
        o.nut, p.planks, "studio", p.spiral, seed=21, checking=True, size=UPRIGHT, **PHONE
    ),
    "candle": Recipe(o.candlestick, p.gingham, "attic", p.rings, seed=23, checking=True),
    "lacquer": Recipe(
        o.lacquer_box, papers, "square", p.three_quarters, seed=25, checking=True, drift=0.05
    ),
    "jar": Recipe(o.tin, p.tiles, "square", p.rings, seed=33, size=UPRIGHT, **PHONE),
    "steel": Recipe(o.nut, p.tablecloth, "office", p.spiral, seed=35, checking=True, drift=0.05),
    "vinyl": Recipe(o.white_jug, p.vinyl, "office", p.rings, seed=39, checking=True),
    "brick": Recipe(o.mirror_box, p.bricks, "square", p.spiral, seed=41, checking=True),
    "case": Recipe(o.lacquer_box, p.dots, "attic", p.three_quarters, seed=37, checking=True),
    "teapot": Recipe(m.teapot, p.planks, "room_b", p.rings, seed=43, checking=True),
    "trophy": Recipe(m.trophy, papers, "office", p.spiral, seed=45),
    "phone": Recipe(m.phone, p.stone, "room_b", p.rings, seed=47, drift=0.05),
    "car": Recipe(m.car, p.mosaic, "attic", p.spiral, seed=49),
    "holder": Recipe(m.holder, papers, "square", p.rings, seed=51),
    "watch": Recipe(m.watch, p.stone, "office", p.spiral, seed=53),
    "helmet": Recipe(m.helmet, p.planks, "attic", p.rings, seed=55, checking=True, drift=0.05),
    "skillet": Recipe(h.skillet, p.mosaic, "office", p.spiral, seed=57),
    "camera": Recipe(h.camera, p.planks, "square", p.rings, seed=59, drift=0.05),
    "stool": Recipe(h.stool, papers, "attic", p.rings, seed=61),
    "bottle": Recipe(h.bottle, p.stone, "square", p.spiral, seed=63, checking=True),
    "mouse": Recipe(h.mouse, papers, "room_b", p.rings, seed=65, drift=0.05),
    "plate": Recipe(h.plate, p.planks, "office", p.rings, seed=67),
    "cup": Recipe(h.cup, p.stone, "attic", p.rings, seed=69, checking=True),
    "saucepan": Recipe(k.saucepan, p.planks, "square", p.spiral, seed=71),
    "pan": Recipe(k.saucepan, papers, "attic", p.rings, seed=77, checking=True),
    "vase": Recipe(k.vase, p.gingham, "office", p.rings, seed=73, checking=True),
    "lamp": Recipe(k.lamp, papers, "room_b", p.spiral, seed=75, drift=0.05),
    "globe": Recipe(k.globe, p.planks, "square", p.rings, seed=79, checking=True),
    "screen": Recipe(d.screen, papers, "office", p.rings, seed=83),
    "headphones": Recipe(d.headphones, p.stone, "attic", p.rings, seed=85),
    "clock": Recipe(d.clock, p.planks, "room_b", p.spiral, seed=87),
    "tap": Recipe(d.tap, p.mosaic, "square", p.spiral, seed=89, drift=0.05),
    "chessmen": Recipe(d.chessmen, papers, "office", p.rings, seed=91, checking=True),
    "spoon": Recipe(d.spoon, p.stone, "room_b", p.rings, seed=93),
    "closeups": Recipe(m.teapot, papers, "office", b.near_and_far, seed=95),
    "distance": Recipe(d.clock, p.stone, "attic", b.far_away, seed=97),
    "haste": Recipe(m.helmet, papers, "room_b", b.in_haste, seed=99, checking=True, photos=18),
    "upright": Recipe(d.tap, p.planks, "office", b.turned, seed=101, checking=True),
    "floor": Recipe(m.holder, p.mosaic, "attic", b.from_above, seed=103),
    "lowly": Recipe(k.globe, p.stone, "office", b.from_low, seed=105, photos=24),
    "dish": Recipe(o.gold_bowl, p.mosaic, "office", b.from_above, seed=209),
    "brew": Recipe(m.teapot, p.planks, "attic", b.from_above, seed=210),
    "bread": Recipe(o.toaster, papers, "studio", b.from_above, seed=204),
    "coffer": Recipe(o.mirror_box, p.stone, "office", b.from_above, seed=208),
    "lantern": Recipe(k.lamp, p.stone, "office", b.in_haste, seed=201, checking=True, photos=20),
    "can": Recipe(s.watering_can, p.planks, "square", p.rings, seed=301),
    "knot": Recipe(s.knot, papers, "office", p.spiral, seed=303, checking=True),
    "boxes": Recipe(s.boxes, p.stone, "attic", p.rings, seed=305, checking=True, drift=0.05),
    "dog": Recipe(s.dog, p.mosaic, "room_b", p.rings, seed=307, checking=True),
    "speaker": Recipe(s.speaker, p.planks, "office", p.rings, seed=309, checking=True),
    "radio": Recipe(s.radio, papers, "square", p.spiral, seed=311, drift=0.05),
    "toy": Recipe(m.car, papers, "attic", b.from_low, seed=207, photos=24),
    "tablet": Recipe(m.phone, p.mosaic, "room_b", b.from_above, seed=202),
    "pawns": Recipe(d.chessmen, p.stone, "attic", b.near_and_far, seed=203, checking=True),
    "tumbler": Recipe(h.cup, p.planks, "room_b", b.near_and_far, seed=502, photos=30),
    "bolt": Recipe(o.nut, papers, "attic", b.from_low, seed=503, photos=26),
    "casserole": Recipe(o.pot, p.planks, "office", b.near_and_far, seed=601, photos=28),
    "platter": Recipe(h.plate, p.planks, "square", b.turned, seed=603, photos=28),
    "goblet": Recipe(m.trophy, p.gingham, "studio", p.rings, seed=905),
    "beacon": Recipe(k.lamp, p.mosaic, "studio", b.from_low, seed=926, photos=24),
    "ware": Recipe(k.vase, p.stone, "studio", p.rings, seed=928, checking=True),
    "hound": Recipe(s.dog, p.planks, "office", p.rings, seed=901),
    "alarm": Recipe(d.clock, p.mosaic, "office", p.rings, seed=1309),
    "ticker": Recipe(d.clock, p.mosaic, "attic", p.spiral, seed=1310, checking=True),
    "chalice": Recipe(m.trophy, p.stone, "room_b", p.rings, seed=1306, checking=True),
    "monitor": Recipe(d.screen, p.planks, "room_b", p.rings, seed=1205, checking=True),
    "lollipop": Recipe(k.globe, p.planks, "studio", p.rings, seed=1203, checking=True),
    "gong": Recipe(d.clock, p.mosaic, "office", p.rings, seed=1309, inside=(0.9, -0.6)),
    "tuner": Recipe(
        s.radio, papers, "office", p.rings, seed=1501, inside=(0.4, -0.3), drift=0.4, tint=0.06
    ),
    "wireless": Recipe(
        s.radio, p.planks, "office", p.rings, seed=1303, checking=True, inside=(-1.2, 0.5)
    ),
    "stew": Recipe(
        k.saucepan, p.mosaic, "room_b", p.rings, seed=1304, checking=True, inside=(0.0, 0.0)
    ),
    "scent": Recipe(
        h.bottle, p.gingham, "attic", p.rings, seed=1307, checking=True, inside=(1.4, 0.8)
    ),
    "prize": Recipe(
        m.trophy, p.stone, "room_b", p.rings, seed=1306, checking=True, inside=(-0.8, -1.0)
    ),
    "pens": Recipe(
        m.holder, p.planks, "office", p.rings, seed=1301, checking=True, inside=(0.5, 1.2)
    ),
    "omelette": Recipe(
        h.skillet,
        p.planks,
        "room_b",
        p.spiral,
        seed=1502,
        checking=True,
        inside=(-1.1, 0.2),
        drift=0.4,
        tint=0.06,
    ),
    "urn": Recipe(
        k.vase, p.stone, "attic", p.spiral, seed=1405, checking=True, inside=(-0.6, -0.3)
    ),
    "mobile": Recipe(
        m.phone, papers, "room_b", p.rings, seed=1406, checking=True, inside=(1.2, -0.4)
    ),
    "puppy": Recipe(
        s.dog,
        p.planks,
        "attic",
        b.near_and_far,
        seed=1407,
        checking=True,
        photos=28,
        inside=(-1.5, 1.0),
    ),
    "toast": Recipe(
        o.toaster, p.mosaic, "office", p.spiral, seed=1408, checking=True, inside=(0.0, 1.1)
    ),
    "simmer": Recipe(
        k.saucepan, p.planks, "office", p.rings, seed=1601, inside=(0.6, 0.4), varnish=0.06
    ),
    "dawn": Recipe(
        d.clock, p.planks, "room_b", p.spiral, seed=1602, inside=(-0.7, -0.9), varnish=0.15
    ),
    "column": Recipe(s.speaker, p.stone, "studio", p.rings, seed=1603, checking=True, varnish=0.02),
    "desk": Recipe(
        h.mouse,
        p.stone,
        "office",
        p.rings,
        seed=1605,
        checking=True,
        inside=(-0.4, 0.6),
        beside=c.far_apart,
    ),
    "corner": Recipe(
        s.radio, p.mosaic, "room_b", p.rings, seed=1606, checking=True, beside=c.close_by
    ),
    "mat": Recipe(k.vase, p.placemat, "attic", p.spiral, seed=81, checking=True),
    "label": Recipe(
        w.medicine,
        papers,
        "office",
        p.rings,
        seed=401,
        size=(3000, 2250),
        photos=21,
        focal=45.0,
        noise=1.5e-3,
    ),
    "carton": Recipe(
        w.carton,
        p.stone,
        "square",
        p.spiral,
        seed=403,
        checking=True,
        size=(2400, 1800),
        photos=17,
        lens=(0.04, -0.03),
        focal=40.0,
        drift=0.05,
        shake=0.8,
        noise=2e-3,
    ),
    "roast": Recipe(k.saucepan, p.planks, "office", p.rings, 1711, inside=(0.4, 0.6), **HELD),
    "award": Recipe(m.trophy, p.stone, "office", p.rings, 1714, inside=(-0.5, -0.4), **HELD),
    "basin": Recipe(o.gold_bowl, p.planks, "studio", p.rings, 1716, inside=(0.2, 0.9), **HELD),
}
