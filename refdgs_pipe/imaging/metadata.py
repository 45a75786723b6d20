"""What the camera wrote beside the pixels (EXIF 2.32), of any format."""

import logging
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import exifread

from refdgs_pipe.artifacts.views import Exif
from refdgs_pipe.files.kinds import sniff
from refdgs_pipe.trouble import raise_if_machine

SAME_SHAPE = 0.01  # of the ratio of sides
SAME_SIZE = 0.03  # of the long side: RAW converters cut some pixels at the rim
CAMERA_PIXELS = 6_000_000

_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # FocalPlaneResolutionUnit


def read_exif(path: Path) -> Exif:
    """The EXIF of a photo; empty fields where there is none or it is damaged."""
    logging.getLogger("exifread").setLevel(logging.CRITICAL)
    try:
        with _exif_of(path) as file:
            tags = exifread.process_file(file, details=False)
    except Exception as error:  # exifread raises whatever a damaged block leads it to
        raise_if_machine(error)
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
        exif_width=_whole(tags, "EXIF ExifImageWidth"),
        exif_height=_whole(tags, "EXIF ExifImageLength"),
        flash=_flash(tags),
    )


def _exif_of(path: Path) -> BinaryIO:
    """The file; of HEIC and AVIF the TIFF block in it, which exifread finds only in some."""
    if sniff(path) in ("heic", "avif"):
        data = path.read_bytes()
        starts = [data.find(b"Exif\0\0" + order) for order in (b"II*\0", b"MM\0*")]
        at = max(starts)
        return BytesIO(data[at + 6 :] if at >= 0 else b"")
    return path.open("rb")


def held_against(exif: Exif, width: int, height: int) -> Exif:
    """What of the EXIF can hold for a file of this size (pixels): software may have changed it.

    * The EXIF's size has another shape: the photo was cropped, and the focal length says nothing
      about what is left.
    * The same shape, another size: it was resized, and the pixels per unit on the focal plane
      belong to the EXIF's size. Their quotient, the sensor's width, holds.
    * The same size: either the file is the camera's, or software rewrote the size and left the
      pixels per unit, which then give a sensor that is too small. Without a 35 mm equivalent to
      compare with, photos below 6 megapixels, as no camera that writes pixels per unit takes now,
      give no sensor width.
    """
    if not (exif.exif_width and exif.exif_height and width and height):
        return exif
    long, short = max(width, height), min(width, height)
    exif_long = max(exif.exif_width, exif.exif_height)
    exif_short = min(exif.exif_width, exif.exif_height)
    rounding = 1.0 / short + 1.0 / exif_short
    if abs(long / short * exif_short / exif_long - 1) > max(SAME_SHAPE, rounding):
        return replace(exif, is_whole=False)
    is_same_size = abs(long / exif_long - 1) < SAME_SIZE
    if is_same_size and not exif.focal_35mm and width * height < CAMERA_PIXELS:
        return replace(exif, sensor_width_mm=None)
    return exif


def _flash(tags: dict[str, Any]) -> bool | None:
    """Whether the flash fired: bit 0 of the tag Flash."""
    values = getattr(tags.get("EXIF Flash") or tags.get("Image Flash"), "values", None)
    return bool(values[0] & 1) if values and isinstance(values[0], int) else None


def _whole(tags: dict[str, Any], key: str) -> int | None:
    value = _number(tags, key)
    return int(value) if value and value < 1e6 else None


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
