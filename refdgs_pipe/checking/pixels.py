"""What the pixels of small photos say: too dark, clipped, unevenly exposed."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.views import View, Views
from refdgs_pipe.color import fractions, srgb_from_linear
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.files.images import read_png

F32 = NDArray[np.float32]

WHITE = 250 / 255  # sRGB, from which on a channel counts as clipped
CLIPPED = 0.1  # share of the object's pixels, or of the photo's without a mask
BRIGHT = 0.99  # quantile that stands for a photo's bright parts
DARK = 0.2  # sRGB of the bright parts of a photo that is too dark: 3 % of the light of white
STOPS = 0.5  # by which exposures may differ


@dataclass(frozen=True)
class Exposure:
    """How a photo is exposed.

    Args:
        clipped: share of its pixels with a channel at white; of the object's, with a mask.
        bright: sRGB luminance of its bright parts, in [0, 1].
    """

    clipped: float
    bright: float

    @property
    def is_dark(self) -> bool:
        return self.bright < DARK

    @property
    def is_clipped(self) -> bool:
        return self.clipped > CLIPPED


def exposures_of(views: Views) -> dict[str, Exposure]:
    """Name of a view -> how it is exposed; views whose picture is damaged are left out."""
    found = {}
    for view in views.items:
        try:
            found[view.name] = _exposure(views, view)
        except (CorruptError, cv2.error):
            continue
    return found


def _exposure(views: Views, view: View) -> Exposure:
    rgb = fractions(read_png(views.image_path(view)))
    if views.color_space == "linear":
        rgb = srgb_from_linear(rgb)
    path = views.mask_path(view)
    chosen = np.ones(rgb.shape[:2], np.bool_)
    if path is not None:
        chosen = fractions(read_png(path)) > 0.5
    pixels = rgb[chosen] if chosen.any() else rgb.reshape(-1, 3)
    luminance = pixels @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    clipped = float((pixels.max(1) >= WHITE).mean())
    return Exposure(clipped, float(np.quantile(luminance, BRIGHT)))


def stops_apart(views: Views) -> float | None:
    """How many stops the cameras' own exposures differ by; None where EXIF does not tell."""
    values = []
    for view in views.items:
        exif = view.exif
        if exif.exposure_s is None:
            return None
        values.append(exif.exposure_s * (exif.iso or 100.0) / (exif.aperture or 1.0) ** 2)
    return float(np.log2(max(values) / min(values))) if values and min(values) > 0 else None
