"""Image files <-> arrays. Formats are told by content, never by suffix."""

import struct
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageCms

from refdgs_pipe.errors import CaptureError, CorruptError
from refdgs_pipe.files.heif import heif_size, read_heif
from refdgs_pipe.files.kinds import sniff
from refdgs_pipe.formatting import printable
from refdgs_pipe.trouble import raise_if_machine

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

MAX_PIXELS = 300_000_000  # larger headers are refused before anything is decoded
LARGE = 50_000_000  # pixels: such photos are decoded one at a time
_MAX_PACKED = 200  # bytes of pixels for a byte of the file: photos pack ten times better at most
Image.MAX_IMAGE_PIXELS = MAX_PIXELS
# what Pillow and its plugins raise for damaged files
_DAMAGE = (
    *(OSError, SyntaxError, ValueError, KeyError, TypeError, IndexError, AttributeError),
    *(OverflowError, ZeroDivisionError, AssertionError, EOFError, struct.error, cv2.error),
    Image.DecompressionBombError,
)
_alone = threading.Lock()
_PILLOW = {"jpeg": "JPEG", "png": "PNG", "webp": "WEBP", "tiff": "TIFF", "avif": "AVIF"}


@dataclass(frozen=True)
class Header:
    """What a file says about itself before it is decoded; size as stored, not upright."""

    format: str
    width: int
    height: int
    orientation: int


def read_header(path: Path) -> Header:
    """Format, size and EXIF orientation, without decoding.

    Raises:
        CaptureError: not an image, or too large to be a photo.
    """
    kind = sniff(path)
    if kind not in (*_PILLOW, "heic"):
        raise CaptureError(_named(path, "not a photo"))
    try:
        if kind == "heic":
            return _header(path, kind, *heif_size(path), 1)  # libheif turns it
        with _quiet(), _open(path, kind) as image:
            width, height = image.size
            # Pillow decodes a whole PNG to find EXIF behind the pixels
            is_odd = _packs_oddly(width, height, path.stat().st_size)
            orientation = 1 if is_odd else int(image.getexif().get(0x0112, 1))
            if kind == "tiff":  # Pillow turns TIFFs, and only these, by itself
                width, height = (int(image.getexif()[tag]) for tag in (0x0100, 0x0101))
    except _DAMAGE as error:
        raise_if_machine(error)
        raise CaptureError(_named(path, f"damaged {kind} header ({error})")) from None
    return _header(path, kind, width, height, orientation)


def _header(path: Path, kind: str, width: int, height: int, orientation: int) -> Header:
    if width * height > MAX_PIXELS:
        text = f"{width} x {height} pixels; at most {MAX_PIXELS} are read"
        raise CaptureError(_named(path, text))
    return Header(kind, width, height, orientation if 1 <= orientation <= 8 else 1)


def read_photo(
    path: Path, *, upright: bool = True, side: int | None = None, is_mask: bool = False
) -> Pixels:
    """Decode a photo strictly.

    Args:
        upright: turn the pixels as the EXIF orientation asks.
        side: pixels that the long side needs; a JPEG of at least four times as many may come
            smaller than it is, with at least twice as many. None: as it is.
        is_mask: plain areas are expected: it may pack better than any photo does.

    Returns:
        (H, W, 3 or 4) sRGB-encoded, uint8, or uint16 for a 16-bit PNG or TIFF.

    Raises:
        CaptureError: not an image, truncated, or of a kind that is not read.
    """
    header = read_header(path)
    data = path.read_bytes()
    if header.format == "jpeg" and data.rfind(b"\xff\xd9") < len(data) // 2:
        raise CaptureError(_named(path, "the JPEG ends early. Copy it again from the card"))
    is_large = header.width * header.height > LARGE
    if not is_mask and _packs_oddly(header.width, header.height, len(data)):
        raise CaptureError(_named(path, f"{len(data)} bytes cannot be a photo of this size"))
    try:
        with _alone if is_large else nullcontext():
            if header.format == "heic":
                pixels = _decode_heif(path)
            elif _is_16bit(path, data):
                pixels = _decode_16bit(data, header)
            else:
                del data
                pixels = _decode(path, header, side)
    except _DAMAGE as error:
        raise_if_machine(error)
        raise CaptureError(_named(path, f"{error}. Copy it again from the card")) from None
    return orient(pixels, header.orientation) if upright else pixels


def _packs_oddly(width: int, height: int, size: int) -> bool:
    """Whether a large picture has fewer bytes than any photo of its size."""
    return width * height > LARGE and 3 * width * height > _MAX_PACKED * size


def orient(pixels: Pixels, orientation: int) -> Pixels:
    """Turn pixels (H, W, ...) as EXIF orientation 1 to 8 asks (TIFF 6.0 section 8)."""
    turned: Any = pixels
    if orientation in (5, 6, 7, 8):
        turned = turned.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        turned = turned[:, ::-1]
    if orientation in (3, 4, 7, 8):
        turned = turned[::-1]
    out: Pixels = np.ascontiguousarray(turned)
    return out


def read_png(path: Path) -> Pixels:
    """One of our own PNGs: (H, W) or (H, W, 3), uint8 or uint16.

    Raises:
        CorruptError: missing or damaged.
    """
    try:
        data = np.fromfile(path, np.uint8)
    except OSError as error:
        raise_if_machine(error)
        raise CorruptError(f"{path}: {error.strerror}") from None
    image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if image is None:
        _could_hold(path)
        raise CorruptError(f"{path}: damaged PNG")
    out: Pixels = _rgb(image)
    return out


def _could_hold(path: Path) -> None:
    """OpenCV says of a picture that memory does not suffice for only that it is none.

    Raises:
        MemoryError: it does not suffice.
    """
    with suppress(CaptureError):
        header = read_header(path)
        np.empty(16 * header.width * header.height, np.uint8)


def write_png(path: Path, pixels: Pixels) -> None:
    """Write (H, W) or (H, W, 3 or 4), uint8 or uint16, fast rather than small."""
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(".png", _rgb(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 2])
    if not done:
        raise ValueError(f"{path.name}: cannot encode {pixels.shape} {pixels.dtype} as PNG")
    path.write_bytes(data.tobytes())


def _rgb(image: Any) -> Any:
    """Swap red and blue; the same both ways."""
    if image.ndim == 2:
        return image
    return image[..., ::-1] if image.shape[2] == 3 else image[..., [2, 1, 0, 3]]


def _named(path: Path, text: str) -> str:
    return printable(f"{path.name}: {text}")


def _open(source: Any, kind: str) -> Image.Image:
    return Image.open(source, formats=[_PILLOW[kind]])


@contextmanager
def _quiet() -> Iterator[None]:
    """Pillow warns of large sizes and odd EXIF; what matters is raised."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _is_16bit(path: Path, data: bytes) -> bool:
    kind = sniff(path)
    if kind == "png":
        return data[24] == 16
    if kind == "tiff":
        with _quiet(), _open(BytesIO(data), kind) as image:
            bits = getattr(image, "tag_v2", {}).get(258, (8,))
            return int(np.max(bits)) > 8
    return False


def _decode_16bit(data: bytes, header: Header) -> Pixels:
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        np.empty(16 * header.width * header.height, np.uint8)  # OpenCV is silent about memory
        raise ValueError(f"damaged {header.format}")
    if image.dtype != np.uint16:
        raise ValueError(f"{image.dtype} samples are not read: export 8 or 16 bits")
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(_rgb(image))


def _decode_heif(path: Path) -> Pixels:
    pixels, profile = read_heif(path)
    if not profile:
        return pixels
    mode = "RGBA" if pixels.shape[2] == 4 else "RGB"
    return np.array(_to_srgb(Image.fromarray(pixels), profile, mode))


def _decode(path: Path, header: Header, side: int | None) -> Pixels:
    with _quiet(), _open(path, header.format) as image:
        if side is not None and header.format == "jpeg":
            scale = max(header.width, header.height) / (2 * side)
            if scale >= 2:  # libjpeg halves, quarters or takes an eighth, never below this size
                image.draft(None, (int(header.width / scale), int(header.height / scale)))
        image.load()
        alpha = "A" in image.getbands() or "transparency" in image.info
        profile = image.info.get("icc_profile")
        picture = image.convert("RGBA" if alpha else "RGB") if not profile else image
        if profile:
            picture = _to_srgb(image, profile, "RGBA" if alpha else "RGB")
        pixels = np.array(picture)
        undo = {6: 8, 8: 6}.get(header.orientation, header.orientation)
        return orient(pixels, undo) if header.format == "tiff" else pixels


def _to_srgb(image: Image.Image, profile: bytes, mode: str) -> Image.Image:
    """Phones write Display P3, studios Adobe RGB; a profile that cannot be used is left out."""
    if image.mode not in ("RGB", "RGBA", "CMYK"):
        return image.convert(mode)
    try:
        source = ImageCms.ImageCmsProfile(BytesIO(profile))
        target = ImageCms.createProfile("sRGB")
        color = image if image.mode == "CMYK" else image.convert("RGB")
        converted = ImageCms.profileToProfile(color, source, target, outputMode="RGB")
    except (ImageCms.PyCMSError, OSError):
        return image.convert(mode)
    if converted is None:
        return image.convert(mode)
    if mode == "RGBA":
        converted.putalpha(image.convert("RGBA").getchannel("A"))
    return converted
