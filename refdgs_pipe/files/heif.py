"""HEIC and HEIF, decoded in a process of its own: libheif is C++ and its input may be hostile."""

import resource
import struct
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.child_process import ChildCrashed, ChildKilled, ChildTimeout, call_in_child
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.formatting import printable
from refdgs_pipe.trouble import raise_if_machine

U8 = NDArray[np.uint8]

TIME_S = 120.0
MEMORY = 12_000_000_000  # bytes of address space for the child
_HEAD = 1 << 20  # bytes in which the boxes that describe the picture lie


def heif_size(path: Path) -> tuple[int, int]:
    """Width and height as stored, from the largest `ispe` box (ISO/IEC 23008-12, 6.5.3).

    Raises:
        CaptureError: there is none.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD)
    sizes: list[tuple[int, int]] = []
    at = head.find(b"ispe")
    while 0 <= at <= len(head) - 16:
        width, height = struct.unpack(">II", head[at + 8 : at + 16])
        sizes.append((int(width), int(height)))
        at = head.find(b"ispe", at + 4)
    width, height = max(sizes, key=lambda size: size[0] * size[1], default=(0, 0))
    if width * height == 0:
        raise CaptureError(printable(f"{path.name}: damaged heic header"))
    return width, height


def read_heif(path: Path) -> tuple[U8, bytes | None]:
    """The main picture, (H, W, 3 or 4) uint8, upright as its own boxes ask, and its ICC profile.

    The EXIF orientation is not to be applied: the boxes say it already (ISO/IEC 23008-12, 6.5.10).

    Raises:
        CaptureError: damaged, or its decoder crashed or took too long.
    """
    try:
        pixels, profile = call_in_child(
            "refdgs_pipe.files.heif:decode", {"path": path}, timeout_s=TIME_S
        )
    except (ChildCrashed, ChildTimeout) as error:
        if isinstance(error, ChildKilled):
            raise
        reason = str(error).partition("\n")[0].partition(":decode ")[2]
        text = f"{path.name}: the HEIC decoder {reason}. Export it as JPEG"
        raise CaptureError(printable(text)) from None
    except (RuntimeError, ValueError, OSError, EOFError, SyntaxError, MemoryError) as error:
        raise_if_machine(error)
        text = f"{path.name}: damaged heic ({error}). Copy it again, or export it as JPEG"
        raise CaptureError(printable(text)) from None
    return pixels, profile


def decode(path: Path) -> tuple[U8, bytes | None]:
    """The child's side of `read_heif`.

    Raises:
        ValueError: libheif does not read it.
    """
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (int(TIME_S), int(TIME_S)))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    library = _library()
    picture = library.open_heif(BytesIO(path.read_bytes()), convert_hdr_to_8bit=True)
    if picture.mode not in ("RGB", "RGBA", "L", "LA"):
        picture = picture.convert_to("RGB") if hasattr(picture, "convert_to") else picture
    pixels = np.array(picture, np.uint8)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    return np.ascontiguousarray(pixels), picture.info.get("icc_profile")


def _library() -> Any:
    """The user's pillow_heif, which reads more; or pi_heif, which comes with us."""
    try:
        return import_module("pillow_heif")
    except ImportError:
        return import_module("pi_heif")
