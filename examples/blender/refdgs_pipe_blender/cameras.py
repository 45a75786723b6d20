"""The cameras of the photos, read from scene.usda and turned into Blender's terms. No bpy here.

Blender's own import of USD changes from version to version. The file is written by refdgs-pipe,
as text, and what is read here are only names and numbers.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

from .errors import AddonError

FILM_MM = 36.0  # width of the film in Blender: only ratios are known
MOST = 256_000_000  # bytes of a scene.usda
_CAMERA = re.compile(r'^[ \t]*def Camera "([A-Za-z0-9_]+)"', re.MULTILINE)
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_MATRIX = re.compile(r"\bmatrix4d xformOp:transform = ([^\n]*)")

Matrix = tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True)
class PhotoCamera:
    """A camera of a photo, as Blender has it: metres, +Z up; it looks along its -Z, +Y is up.

    Args:
        name: as in scene.usda.
        pose: (4, 4) world from camera, rows.
        lens_mm: focal length for a film FILM_MM wide.
        shift_x, shift_y: Blender's shifts, in widths of the film.
        aspect: height of the film / its width.
    """

    name: str
    pose: Matrix
    lens_mm: float
    shift_x: float
    shift_y: float
    aspect: float


def read_cameras(path: Path) -> list[PhotoCamera]:
    """The cameras of a scene.usda, in its order. There may be none.

    Raises:
        AddonError: it cannot be read, or a camera is not as refdgs-pipe writes it.
    """
    try:
        if path.stat().st_size > MOST:
            raise AddonError(f"{path}: too large for a scene of refdgs-pipe. Run again")
        text = path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise AddonError(f"{path}: cannot be read ({error}). Run again") from None
    if not text.startswith("#usda 1.0"):
        raise AddonError(f"{path}: this is no USD text. Run again")
    starts = list(_CAMERA.finditer(text))
    ends = [found.start() for found in starts[1:]] + [len(text)]
    cameras = []
    for found, end in zip(starts, ends, strict=True):
        try:
            cameras.append(_camera(found[1], text[found.end() : end]))
        except ValueError as error:
            raise AddonError(f"{path}: camera {found[1]}: {error}. Run again") from None
    return cameras


def z_up(rows: Matrix) -> Matrix:
    """A pose in Blender's world, which has +Z up, of a pose in the asset's, which has +Y up.

    It is the turn that Blender's import of glTF makes: (x, y, z) -> (x, -z, y).
    """
    x, y, z, last = rows
    a, b, c, d = (0.0 - value for value in z)
    return x, (a, b, c, d), y, last


def _camera(name: str, body: str) -> PhotoCamera:
    """One camera of the text between its name and the next camera.

    Raises:
        ValueError: something is missing or impossible.
    """
    focal, width, height = (
        _value(body, key) for key in ("focalLength", "horizontalAperture", "verticalAperture")
    )
    right, up = (_value(body, f"{side}ApertureOffset") for side in ("horizontal", "vertical"))
    if min(focal, width, height) <= 0:
        raise ValueError("its focal length and its film must be above 0")
    return PhotoCamera(
        name=name,
        pose=z_up(_pose(body)),
        lens_mm=FILM_MM * focal / width,
        shift_x=right / width,
        shift_y=up / width,
        aspect=height / width,
    )


def _value(body: str, key: str) -> float:
    """The number of an attribute.

    Raises:
        ValueError: there is none, or it is not finite.
    """
    found = re.search(rf"\bfloat {key} = ({_NUMBER})\s*$", body, re.MULTILINE)
    if found is None or not math.isfinite(float(found[1])):
        raise ValueError(f"{key} is missing or not a number")
    return float(found[1])


def _pose(body: str) -> Matrix:
    """(4, 4) world from camera. USD multiplies rows, so its text has the transpose.

    Raises:
        ValueError: it is missing, or not a rotation with a position.
    """
    found = _MATRIX.search(body)
    numbers = [float(text) for text in re.findall(_NUMBER, found[1])] if found else []
    if len(numbers) != 16 or not all(map(math.isfinite, numbers)):
        raise ValueError("its place is missing or not a matrix of 16 numbers")
    columns = [numbers[i : i + 4] for i in range(0, 16, 4)]
    if any(abs(math.hypot(*column[:3]) - 1) > 1e-3 for column in columns[:3]):
        raise ValueError("its place is not a rotation with a position")
    a, b, c, d = columns
    return tuple(zip(a, b, c, d, strict=True))
