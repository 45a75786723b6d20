"""Copies of a photo become one: the same file, or the same picture encoded or resized again.

Two photos from almost the same place are no copies. Both are compared as grey pictures of 192 x 192
(96 x 96 where one of them is smaller than 600 pixels), and a copy has to pass three limits:

* `BLOCK`: no 1/16 x 1/16 of the picture differs in its mean by more than this many 8-bit levels;
* `SHIFT`: least squares over brightness gradients finds the whole picture moved by less than this,
  in 1/192 of the side (0.03 are a quarter of a pixel in a photo of 1600);
* `LOCAL`: the same for each 1/8 x 1/8 of the picture.

The last two have a second value for photos of different sizes, which one camera does not take in a
row and which resizing moves a little. Measured on 50 photos of a fox (1080 x 1920) and 66 of a
skull (1600 x 1067): the closest two different photos differ by 22 and 60 levels in a block. Of a
burst that moved by 0.25 pixels of 1600, with noise of its own, SHIFT is 0.041 or more; where only
1/8 x 1/6 of the picture moved by 4 pixels of 1600, LOCAL is 0.15 or more. The farthest copies
(these photos and those of a turntable, 640 x 480) have: JPEG of quality 20 to 90 and WebP, 2.2
levels, SHIFT 0.022, LOCAL 0.10; 0.37 to 1.7 of the size, and 320 pixels, 2.6 levels, 0.057, 0.28.
What this cannot tell apart are two shots of one still scene from a tripod: they count as one.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.capture import Frame, safe_names
from refdgs_pipe.artifacts.views import Skipped, View
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.images import Pixels, read_header, read_png

F32 = NDArray[np.float32]

BLOCK = 4.0  # 8-bit levels
SHIFT, LOCAL = (0.03, 0.08), (0.12, 0.5)  # of photos of one size, and of different sizes
_FINE, _COARSE, _BLOCKS, _PARTS = 192, 96, 16, 8
_SMALL = 600  # pixels of the long side
_ASPECT = 0.01
_GRAY = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True)
class Look:
    """A photo as (192, 192), (96, 96) and (16, 16) grey levels of 0 to 255, and its size."""

    fine: F32
    coarse: F32
    blocks: F32
    width: int
    height: int


def look_of(pixels: Pixels, *, linear: bool) -> Look:
    """What `are_copies` compares, of a photo (H, W, 3), sRGB-encoded or linear."""
    color = pixels[..., :3].astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    fine_color = cv2.resize(color, (_FINE, _FINE), interpolation=cv2.INTER_AREA)
    encoded = srgb_from_linear(fine_color) if linear else fine_color
    fine = np.asarray(encoded @ _GRAY * np.float32(255), np.float32)
    coarse, blocks = (
        np.asarray(cv2.resize(fine, (side, side), interpolation=cv2.INTER_AREA), np.float32)
        for side in (_COARSE, _BLOCKS)
    )
    return Look(fine, coarse, blocks, pixels.shape[1], pixels.shape[0])


def are_copies(one: Look, other: Look) -> bool:
    """Whether two photos are the same picture, up to encoding and size."""
    if abs(one.width * other.height / (one.height * other.width) - 1) > max(
        _ASPECT, 1.5 / min(one.height, one.width, other.height, other.width)
    ):
        return False
    if float(np.abs(one.blocks - other.blocks).max()) > BLOCK:
        return False
    long = min(max(one.width, one.height), max(other.width, other.height))
    a, b = (one.fine, other.fine) if long >= _SMALL else (one.coarse, other.coarse)
    scale = _FINE / len(a)
    middle = (a + b) / 2
    slopes = [cv2.Sobel(middle, cv2.CV_32F, *axes) / 8 for axes in ((1, 0), (0, 1))]
    differ = (one.width, one.height) != (other.width, other.height)
    if scale * _shift(a - b, slopes, hold=1e-6) > SHIFT[differ]:
        return False
    side = len(a) // _PARTS
    parts = [
        (slice(i * side, (i + 1) * side), slice(j * side, (j + 1) * side))
        for i in range(_PARTS)
        for j in range(_PARTS)
    ]
    return all(
        scale * _shift((a - b)[part], [s[part] for s in slopes], hold=4.0) <= LOCAL[differ]
        for part in parts
    )


def _shift(difference: F32, slopes: Sequence[F32], *, hold: float) -> float:
    """Pixels that explain the difference best, as Lucas and Kanade find them; 0 if flat."""
    x, y = (slope.astype(np.float64).ravel() for slope in slopes)
    d = difference.astype(np.float64).ravel()
    normal = np.array([[x @ x, x @ y], [x @ y, y @ y]]) + np.eye(2) * (hold * d.size + 1e-9)
    return float(np.hypot(*np.linalg.solve(normal, np.array([x @ d, y @ d]))))


def without_same_files(frames: Sequence[Frame]) -> tuple[list[Frame], list[Skipped]]:
    """The frames without files whose bytes are those of another, and these."""
    by_size: dict[int, list[Frame]] = {}
    for frame in frames:
        by_size.setdefault(frame.path.stat().st_size, []).append(frame)
    original: dict[Path, Frame] = {}
    for size, alike in by_size.items():
        if size == 0 or len(alike) < 2:
            continue
        by_hash: dict[str, list[Frame]] = {}
        for frame in alike:
            by_hash.setdefault(_hash(frame.path), []).append(frame)
        for same in by_hash.values():
            best = min(same, key=lambda frame: (len(frame.source), frames.index(frame)))
            original |= {frame.path: best for frame in same if frame is not best}
    kept = [frame for frame in frames if frame.path not in original]
    names = [(frame.source, original[frame.path].source) for frame in frames if frame not in kept]
    return kept, [copy_of(name, best) for name, best in names]


def without_copies(
    frames: Sequence[Frame],
    results: Sequence[View | Skipped],
    folder: Path,
    *,
    linear: bool,
) -> list[View | Skipped]:
    """What became of each frame, with copies of a picture turned into Skipped and their files gone.

    Of several the one with a mask is kept; then the largest, that with EXIF, the shortest name, the
    first. Names are as if there had been no copies.
    """
    places = [i for i, result in enumerate(results) if isinstance(result, View)]
    ranks = {i: _rank(frames[i], results[i], i) for i in places}
    looks: dict[int, Look] = {}
    out = list(results)
    kept: list[int] = []
    for i in sorted(places, key=lambda i: ranks[i]):
        view = results[i]
        assert isinstance(view, View)
        looks[i] = look_of(read_png(folder / view.file), linear=linear)
        first = next((k for k in kept if are_copies(looks[i], looks[k])), None)
        if first is None:
            kept.append(i)
            continue
        for file in _files(view):
            (folder / file).unlink()
        out[i] = copy_of(view.source, frames[first].source)
    if len(kept) < len(places):
        _rename(frames, out, folder)
    return out


def copy_of(name: str, original: str) -> Skipped:
    """A copy, as it is reported."""
    return Skipped(name, f"copy of {original}", copy_of=original)


def _rank(frame: Frame, view: View | Skipped, place: int) -> tuple[bool, int, bool, int, int]:
    """Sort key: the best of several copies comes first."""
    assert isinstance(view, View)
    try:
        header = read_header(frame.path)
        pixels = header.width * header.height
    except CaptureError:  # camera RAW
        pixels = 1 << 40
    no_exif = view.exif.focal_mm is None and view.exif.model is None
    return view.mask is None, -pixels, no_exif, len(frame.source), place


def _rename(frames: Sequence[Frame], results: list[View | Skipped], folder: Path) -> None:
    """Give the views, in place, the names that they have where there are no copies."""
    here = [i for i, result in enumerate(results) if isinstance(result, View) or not result.copy_of]
    names = dict(zip(here, safe_names([frames[i].source for i in here]), strict=True))
    moves: list[tuple[Path, Path]] = []
    for i, name in names.items():
        view = results[i]
        if isinstance(view, Skipped) or view.name == name:
            continue
        renamed = replace(
            view,
            name=name,
            file=f"images/{name}.png",
            mask=view.mask and f"masks/{name}.png",
            placing=view.placing and f"placing/{name}.png",
        )
        for old, new in zip(_files(view), _files(renamed), strict=True):
            moves.append((folder / old, folder / new))
        results[i] = renamed
    waiting = [(old.rename(old.with_name(f".{old.name}")), new) for old, new in moves]
    for hidden, target in waiting:
        hidden.rename(target)


def _files(view: View) -> list[str]:
    return [file for file in (view.file, view.mask, view.placing) if file]


def _hash(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=32)).hexdigest()
