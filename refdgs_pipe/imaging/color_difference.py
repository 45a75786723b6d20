"""How different two colours look: CIELAB (CIE 15:2004) and CIEDE2000 (Sharma, Wu, Dalal 2005)."""

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

_XYZ = np.array(  # from linear sRGB, IEC 61966-2-1
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
_WHITE = _XYZ.sum(axis=1)


def lab_from_linear(rgb: F64) -> F64:
    """CIELAB (..., 3), white D65, of linear sRGB (..., 3)."""
    ratio = np.maximum(rgb @ _XYZ.T, 0) / _WHITE
    low = (6 / 29) ** 3
    f = np.where(ratio > low, np.cbrt(ratio), ratio / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def ciede2000(one: F64, other: F64) -> F64:
    """(...,) the difference of CIELAB colours (..., 3); 1 is about what an eye just sees."""
    l1, a1, b1 = np.moveaxis(one, -1, 0)
    l2, a2, b2 = np.moveaxis(other, -1, 0)
    chroma7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    widen = 1.5 - 0.5 * np.sqrt(chroma7 / (chroma7 + 25.0**7))
    c1, c2 = np.hypot(widen * a1, b1), np.hypot(widen * a2, b2)
    h1 = np.degrees(np.arctan2(b1, widen * a1)) % 360
    h2 = np.degrees(np.arctan2(b2, widen * a2)) % 360
    colored = (c1 * c2) > 0
    turn = np.where(colored, (h2 - h1 + 180) % 360 - 180, 0.0)
    turn = np.where(colored & (h2 - h1 == 180), 180.0, turn)
    dl, dc = l2 - l1, c2 - c1
    dh = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))
    light, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    hue = np.where(colored, (h1 + h2) / 2, h1 + h2)
    apart = colored & (np.abs(h1 - h2) > 180)
    hue = np.where(apart, np.where(h1 + h2 < 360, hue + 180, hue - 180), hue)
    cosines = (
        1
        - 0.17 * np.cos(np.radians(hue - 30))
        + 0.24 * np.cos(np.radians(2 * hue))
        + 0.32 * np.cos(np.radians(3 * hue + 6))
        - 0.20 * np.cos(np.radians(4 * hue - 63))
    )
    sl = 1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2)
    sc, sh = 1 + 0.045 * chroma, 1 + 0.015 * chroma * cosines
    bend = 30 * np.exp(-(((hue - 275) / 25) ** 2))
    mixed = -np.sin(np.radians(2 * bend)) * 2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))
    l, c, h = dl / sl, dc / sc, dh / sh
    return np.asarray(np.sqrt(np.maximum(l**2 + c**2 + h**2 + mixed * c * h, 0)))
