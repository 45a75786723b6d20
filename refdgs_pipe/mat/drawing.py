"""The mat as a picture of pixels and as a PDF."""

import zlib
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.mat.design import Box, black_cells, blank_boxes, leaves, ruler, words
from refdgs_pipe.mat.layout import Mat

U8 = NDArray[np.uint8]
F32 = NDArray[np.float32]

POINTS_PER_MM = 72 / 25.4
SUBPIXEL = 4  # bits of cv2's fixed-point coordinates


def picture(mat: Mat, per_mm: float, *, texture: bool = True) -> U8:
    """The mat as (H, W) grey pixels, top row first; markers are exact to a fraction of a pixel.

    Args:
        per_mm: pixels for each millimetre.
        texture: without it the paper is white between the markers.
    """
    size = (round(mat.height * per_mm), round(mat.width * per_mm))
    paper = np.full(size, 255, np.uint8)
    for shape in leaves(mat) if texture else ():
        flipped = np.stack([shape.outline[:, 0], mat.height - shape.outline[:, 1]], 1) * per_mm
        fixed = np.round((flipped - 0.5) * 2**SUBPIXEL).astype(np.int32)
        cv2.fillPoly(paper, [fixed], round(255 * shape.grey), cv2.LINE_AA, SUBPIXEL)
    out = paper.astype(np.float32) / np.float32(255)
    for box in blank_boxes(mat):
        _fill(out, mat, box, 1.0, per_mm)
    black = [box for boxes in black_cells(mat) for box in boxes]
    ink = np.zeros(size, np.float32)
    for box in black + ruler(mat):
        _add_coverage(ink, mat, box, per_mm)
    out *= 1 - np.minimum(ink, 1)
    grey = np.asarray(np.round(out * 255), np.uint8)
    for word in words(mat):
        place = (round(word.x * per_mm), round((mat.height - word.y) * per_mm))
        scale = word.height * per_mm / 30
        cv2.putText(grey, word.text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, 0, 1, cv2.LINE_AA)
    return grey


def pdf(mat: Mat) -> bytes:
    """The mat as a PDF of one page in its exact size, all in vectors but for two lines of text.

    The file is written after ISO 32000-1, sections 7 and 8; equal mats give equal bytes.
    """
    page = b"\n".join(_page(mat))
    media = f"[0 0 {mat.width * POINTS_PER_MM:.4f} {mat.height * POINTS_PER_MM:.4f}]"
    squeezed = zlib.compress(page, 9)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {media} /Contents 4 0 R "
        "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
        f"<< /Length {len(squeezed)} /Filter /FlateDecode >>\nstream\n".encode()
        + squeezed
        + b"\nendstream",
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out = bytearray(b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n" % number + body + b"\nendobj\n"
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\n" % (len(objects) + 1)
    out += b"startxref\n%d\n%%%%EOF\n" % table
    return bytes(out)


def _page(mat: Mat) -> Iterable[bytes]:
    """The page's drawing commands; a marker is one path, so no seams show between its cells."""
    yield f"{POINTS_PER_MM:.8f} 0 0 {POINTS_PER_MM:.8f} 0 0 cm".encode()
    for shape in leaves(mat):
        (x, y), *rest = shape.outline
        lines = " ".join(f"{u:.2f} {v:.2f} l" for u, v in rest)
        yield f"{shape.grey:.3f} g {x:.2f} {y:.2f} m {lines} h f".encode()
    yield b"1 g " + b" ".join(map(_rectangle, blank_boxes(mat))) + b" f"
    for boxes in [*black_cells(mat), ruler(mat)]:
        yield b"0 g " + b" ".join(map(_rectangle, boxes)) + b" f"
    for word in words(mat):
        text = word.text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
        yield f"BT /F {word.height} Tf {word.x:.2f} {word.y:.2f} Td ({text}) Tj ET".encode()


def _rectangle(box: Box) -> bytes:
    size = f"{box.right - box.left:.4f} {box.top - box.low:.4f}"
    return f"{box.left:.4f} {box.low:.4f} {size} re".encode()


def _fill(out: F32, mat: Mat, box: Box, grey: float, per_mm: float) -> None:
    """Paint a rectangle over what is there."""
    cover = np.zeros_like(out)
    rows, columns = _add_coverage(cover, mat, box, per_mm)
    part = cover[rows, columns]
    out[rows, columns] = out[rows, columns] * (1 - part) + grey * part


def _add_coverage(cover: F32, mat: Mat, box: Box, per_mm: float) -> tuple[slice, slice]:
    """Add to each pixel the share of it that the rectangle covers; where these pixels are."""
    columns, across = _shares(box.left * per_mm, box.right * per_mm, cover.shape[1])
    high, low = (mat.height - box.top) * per_mm, (mat.height - box.low) * per_mm
    rows, down = _shares(high, low, cover.shape[0])
    cover[rows, columns] += down[:, None] * across
    return rows, columns


def _shares(start: float, end: float, count: int) -> tuple[slice, F32]:
    """Which pixels of a row an interval touches, and how much of each it covers."""
    first, last = max(int(np.floor(start)), 0), min(int(np.ceil(end)), count)
    edges = np.arange(first, last)
    share = np.minimum(edges + 1, end) - np.maximum(edges, start)
    return slice(first, last), np.clip(share, 0, 1).astype(np.float32)
