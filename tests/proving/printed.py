"""Objects with print as small as on real packets, for photos of many pixels.

Units are scene units of 15 cm, z is up. An object stands at `TABLE_Z`.
"""

import numpy as np
from objects import TABLE_Z, Objects, _box, _turned
from PIL import Image, ImageDraw, ImageFont
from scenes import LIN, obj

METRES = 0.15  # a scene unit
POINT = 0.0254 / 72 / METRES  # a typographic point, scene units
RADIUS, LOW, HIGH = 0.42, 0.12, 0.74  # of the label
FINE = 2045.0  # texels for a scene unit
PERIODS = (0.003, 0.004, 0.006, 0.008, 0.012)  # of the stripes, scene units
SIZES = (12, 9, 7, 6, 5, 4)  # points
WORDS = (
    "Take one tablet with water after each meal.",
    "Keep below 25 degrees, dry, and away from light.",
    "Do not use after the date on the lid: 2031-04.",
    "Contains 60 coated tablets of 250 mg magnesium citrate.",
    "Made by Quick Brown Fox Ltd, 17 Jumping Lane, Lazydog.",
    "Batch 4093-XK-275 / GTIN 04012345678901 / PZN 08675309",
)
COLOURS = (
    ("f4f1e8", "1b1b1b", "9c1c28"),
    ("123a5a", "f2f2ea", "e3b23c"),
    ("e9d8b4", "3b2413", "2f6b3c"),
)


def label() -> np.ndarray:
    """(H, W, 3) linear, the print round a jar; the first row is the lowest."""
    width, height = round(2 * np.pi * RADIUS * FINE), round((HIGH - LOW) * FINE)
    sheet = Image.new("RGB", (width, height))
    draw = ImageDraw.Draw(sheet)
    column = width / len(COLOURS)
    for i, (paper, ink, band) in enumerate(COLOURS):
        left = round(i * column)
        draw.rectangle((left, 0, left + column, height), fill=f"#{paper}")
        draw.rectangle((left, 0, left + column, 0.22 * height), fill=f"#{band}")
        title = ImageFont.load_default(round(36 * POINT * FINE))
        draw.text(
            (left + 60, 40), ("MAGNOLIA", "Cobalt 250", "Nutmeg")[i], font=title, fill=f"#{paper}"
        )
        top = 0.27 * height
        for points, words in zip(SIZES, WORDS[i:] + WORDS[:i], strict=True):
            font = ImageFont.load_default(round(points * POINT * FINE))
            draw.text((left + 60, top), f"{points}  {words}", font=font, fill=f"#{ink}")
            top += 1.9 * points * POINT * FINE
        draw.line((left + 60, top, left + column - 60, top), fill=f"#{ink}", width=4)
    pixels = np.asarray(sheet, np.float64) / 255
    stripes(pixels)
    linear = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)
    return linear[::-1]


def stripes(sheet: np.ndarray) -> None:
    """Draw upright and level stripes, each of a sinusoid's brightness, on (H, W, 3) sRGB."""
    height, width, _ = sheet.shape
    side = round(0.07 * FINE)
    y, x = np.mgrid[0:side, 0:side]
    for i, (top, left) in enumerate(places(height, width)):
        along = x if i % 2 == 0 else y
        wave = 0.5 + 0.3 * np.sin(2 * np.pi * along / (PERIODS[i // 2 % len(PERIODS)] * FINE))
        sheet[top : top + side, left : left + side] = wave[..., None]


def places(height: int, width: int) -> list[tuple[int, int]]:
    """Top and left of each square of stripes: upright and level by turns, fine ones first."""
    side = round(0.08 * FINE)
    found = []
    for i in range(len(COLOURS)):
        left = round((i + 1) * width / len(COLOURS)) - 60 - len(PERIODS) * side
        for k in range(len(PERIODS)):
            for row in range(2):
                found.append((height - 30 - (2 - row) * side, left + k * side))
    return found


def medicine() -> Objects:
    """A varnished paper label with small print on a white jar with a black cap."""
    low, high = LOW - 0.002, HIGH + 0.002
    body = [(1e-4, 0.0), (0.38, 0.0), (0.41, 0.03), (0.41, low), (RADIUS - 0.004, low)]
    neck = [(RADIUS - 0.004, high), (0.41, high), (0.41, 0.79), (0.36, 0.84), (0.33, 0.84)]
    cap = [(0.34, 0.84), (0.36, 0.85), (0.36, 1.0), (0.34, 1.02), (1e-4, 1.02)]
    side = _turned([(RADIUS, LOW), (RADIUS, HIGH)], 0.001)
    white = {"type": "glaze", "base": LIN("e6e6e2"), "alpha": 0.12}
    return [
        obj("label", side, type="glaze", base=label(), alpha=0.1),
        obj("body", _turned(body, 0.006), **white),
        obj("neck", _turned(neck, 0.006), **white),
        obj("cap", _turned(cap, 0.008), type="gloss", base=LIN("141414"), alpha=0.15),
    ]


def carton() -> Objects:
    """A varnished carton with small, mirrored print on every side, and a matte lid beside it."""
    width, height = 2000, 1800
    sheet = Image.new("RGB", (width, height), "#efe9da")
    draw = ImageDraw.Draw(sheet)
    draw.rectangle((0, 0, width, 330), fill="#20503f")
    draw.text((90, 90), "HERBAL TEA", font=ImageFont.load_default(170), fill="#f4e6b8")
    top = 400.0
    for points, words in zip((24, 12, 9, 8, 7, 6, 5), (*WORDS[3:], *WORDS[:4]), strict=True):
        size = round(points * POINT * width)
        draw.text((90, top), words, font=ImageFont.load_default(size), fill="#26201a")
        top += 1.9 * size
    for k in range(8):
        draw.ellipse((120 + 220 * k, 1520, 280 + 220 * k, 1680), fill=("#b5492f", "#2f6f8f")[k % 2])
    pixels = np.asarray(sheet, np.float64) / 255
    linear = np.where(pixels <= 0.04045, pixels / 12.92, ((pixels + 0.055) / 1.055) ** 2.4)
    box = _box((0.5, 0.3, 0.45), (0, 0, TABLE_Z + 0.45), 20)
    lid = _turned([(1e-4, 0.0), (0.16, 0.0), (0.18, 0.02), (0.18, 0.1), (1e-4, 0.12)], 0.008)
    lid["V"] = lid["V"] + np.array([0.62, -0.5, 0.0])
    return [
        obj("carton", box, type="glaze", base=linear[::-1], alpha=0.14),
        obj("lid", lid, type="diffuse", base=LIN("b58a5a")),
    ]
