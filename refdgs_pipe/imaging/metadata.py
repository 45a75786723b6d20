"""What the camera wrote beside the pixels (EXIF 2.32), of any format."""

import logging
from pathlib import Path
from typing import Any

import exifread

from refdgs_pipe.artifacts.views import Exif

_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # FocalPlaneResolutionUnit


def read_exif(path: Path) -> Exif:
    """The EXIF of a photo; empty fields where there is none or it is damaged."""
    logging.getLogger("exifread").setLevel(logging.CRITICAL)
    try:
        with path.open("rb") as file:
            tags = exifread.process_file(file, details=False)
    except Exception:  # exifread raises whatever a damaged block leads it to
        return Exif()
    return Exif(
        make=_text(tags, "Image Make"),
        model=_text(tags, "Image Model"),
        lens=_text(tags, "EXIF LensModel"),
        focal_mm=_number(tags, "EXIF FocalLength"),
        focal_35mm=_number(tags, "EXIF FocalLengthIn35mmFilm"),
        sensor_width_mm=_sensor_width(tags),
        time=_text(tags, "EXIF DateTimeOriginal"),
        exposure_s=_number(tags, "EXIF ExposureTime"),
        aperture=_number(tags, "EXIF FNumber"),
        iso=_number(tags, "EXIF ISOSpeedRatings"),
    )


def _sensor_width(tags: dict[str, Any]) -> float | None:
    """Millimetres of the long side, from the pixels per unit on the focal plane."""
    density = _number(tags, "EXIF FocalPlaneXResolution")
    pixels = _number(tags, "EXIF ExifImageWidth")
    other = _number(tags, "EXIF ExifImageLength")
    unit = _number(tags, "EXIF FocalPlaneResolutionUnit")
    if not (density and pixels):
        return None
    width = max(pixels, other or 0.0) / density * _MM_PER_UNIT.get(int(unit or 2), 25.4)
    return width if 2.0 < width < 80.0 else None


def _number(tags: dict[str, Any], key: str) -> float | None:
    values = getattr(tags.get(key), "values", None)
    try:
        value = float(values[0]) if values else None
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return None
    return value if value and value > 0 else None


def _text(tags: dict[str, Any], key: str) -> str | None:
    text = str(tags[key]).strip(" \0") if key in tags else ""
    return text or None
