"""Films become photos: of every stretch of equal motion the sharpest frame."""

import resource
import shlex
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.child_process import ChildCrashed, ChildKilled, OnProgress, call_in_child
from refdgs_pipe.errors import CaptureError
from refdgs_pipe.files.images import MAX_PIXELS, write_png
from refdgs_pipe.formatting import printable

U8 = NDArray[np.uint8]

MAX_FRAMES = 200_000
LOOKS = 20  # frames that are looked at for each that is taken
MEMORY = 16_000_000_000  # bytes of address space for the child
_MOTION_SIDE, _SHARP_SIDE = 320, 960  # pixels
_LOST = 0.05  # of the long side: motion where nothing could be followed
_PQ, _HLG = 16, 18  # TransferCharacteristics (ITU-T H.273, table 3)


def take_frames(
    path: Path,
    folder: Path,
    *,
    count: int,
    side: int,
    stop: Any = None,
    progress: OnProgress | None = None,
) -> list[tuple[int, Path]]:
    """Write the chosen frames of a film as upright PNGs below `folder`.

    Args:
        count: at most so many frames.
        side: longer frames are reduced to this long side, pixels.
        stop: as in `call_in_child`.

    Returns:
        The number of each frame in the film, and its file, in order.

    Raises:
        CaptureError: HDR, or OpenCV's FFmpeg cannot decode it.
    """
    refuse_hdr(path)
    folder.mkdir(parents=True, exist_ok=True)
    plain = folder / "film"  # FFmpeg takes no file name that is not UTF-8
    plain.unlink(missing_ok=True)
    plain.symlink_to(path.resolve())
    arguments = {"path": plain, "folder": folder, "count": count, "side": side}
    try:
        found = call_in_child(
            "refdgs_pipe.imaging.films:pick_frames", arguments, stop=stop, on_progress=progress
        )
    except ChildCrashed as error:
        if isinstance(error, ChildKilled):
            raise
        reason = str(error).partition("\n")[0].partition(":pick_frames ")[2]
        raise CaptureError(printable(f"{path.name}: the video decoder {reason}")) from None
    except CaptureError as error:
        raise CaptureError(printable(f"{path.name}: {error}")) from None
    finally:
        plain.unlink(missing_ok=True)
    return [(number, folder / name) for number, name in found]


def refuse_hdr(path: Path) -> None:
    """Refuse a film in HLG or PQ: read as it is, its colours would be washed out.

    Raises:
        CaptureError: it is HDR; with the command that converts it.
    """
    transfer = _transfer(path)
    if transfer not in (_PQ, _HLG):
        return
    kind = "PQ (smpte2084)" if transfer == _PQ else "HLG (arib-std-b67)"
    name = printable(path.name)
    out = shlex.quote(f"{Path(name).stem}_sdr.mp4")
    command = (
        f"ffmpeg -i {shlex.quote(name)} -vf zscale=t=linear:npl=203,format=gbrpf32le,"
        "zscale=p=bt709,tonemap=hable:desat=0,zscale=t=bt709:m=bt709:r=tv,format=yuv420p "
        f"-c:v libx264 -crf 14 -an {out}"
    )
    raise CaptureError(f"{name}: HDR video, {kind}, is not read. Convert it first: {command}")


def _transfer(path: Path) -> int:
    """TransferCharacteristics of an MP4's or Matroska file's header; 2 if it does not say."""
    for box in (_movie_box(path), _beginning(path)):
        for kind in (b"colrnclx", b"colrnclc"):
            at = box.find(kind)
            if 0 <= at <= len(box) - 12:
                return int(struct.unpack(">H", box[at + 10 : at + 12])[0])
        for value in (_PQ, _HLG):
            if box[:4] == b"\x1aE\xdf\xa3" and bytes((0x55, 0xBA, 0x81, value)) in box:
                return value
    return 2


def _beginning(path: Path) -> bytes:
    with path.open("rb") as file:
        data = file.read(1 << 20)
    return data if data[:4] == b"\x1aE\xdf\xa3" else b""


def _movie_box(path: Path) -> bytes:
    """The box `moov` of an MP4 or MOV (ISO/IEC 14496-12), or nothing."""
    end = path.stat().st_size
    with path.open("rb") as file:
        at = 0
        for _ in range(1000):
            file.seek(at)
            head = file.read(16)
            if len(head) < 8:
                return b""
            size, kind = struct.unpack(">I4s", head[:8])
            if size == 1 and len(head) == 16:
                size = struct.unpack(">Q", head[8:])[0]
            size = size or end - at
            if kind == b"moov":
                file.seek(at)
                return file.read(min(size, 64 << 20))
            if size < 8:
                return b""
            at += size
    return b""


def pick_frames(
    path: Path, folder: Path, count: int, side: int, progress: Callable[[str, int, int | None], Any]
) -> list[tuple[int, str]]:
    """The child's side of `take_frames`: numbers and names of the files written.

    Raises:
        CaptureError: it cannot be opened or has no frames.
    """
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    film = _open(path)
    total = int(film.get(cv2.CAP_PROP_FRAME_COUNT))
    step = max(1, total // (count * LOOKS))
    numbers: list[int] = []
    moved: list[float] = []
    sharp: list[float] = []
    last: U8 | None = None
    for number in range(MAX_FRAMES):
        if not film.grab():
            break
        if number % step:
            continue
        done, frame = film.retrieve()
        if not done:
            continue
        small = _gray(frame, _MOTION_SIDE)
        moved.append(0.0 if last is None else motion(last, small))
        gray = _gray(frame, _SHARP_SIDE)
        sharp.append(float(cv2.Laplacian(gray, cv2.CV_32F).var()))
        numbers.append(number)
        last = small
        progress("looking at video", number, max(total, number))
    film.release()
    if not numbers:
        raise CaptureError("no frame of the video can be decoded. Convert it to H.264 in MP4")
    chosen = [numbers[i] for i in choose(np.array(moved), np.array(sharp), count)]
    return _write(path, folder, chosen, side)


def choose(moved: NDArray[np.float64], sharp: NDArray[np.float64], count: int) -> list[int]:
    """The sharpest frame of each of at most `count` stretches of equal motion, in order.

    Args:
        moved: (N,) motion since the frame before; sharp: (N,) sharpness, of any unit.
    """
    path = np.cumsum(moved)
    if path[-1] <= 0:
        path = np.arange(len(moved), dtype=float)
    windows = np.minimum((path / max(path[-1], 1e-12) * count).astype(int), count - 1)
    return [
        int(members[sharp[members].argmax()])
        for window in np.unique(windows)
        for members in [np.flatnonzero(windows == window)]
    ]


def motion(before: U8, after: U8) -> float:
    """Median displacement of followed corners, as a share of the long side (Lucas and Kanade)."""
    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 5)
    if corners is None:
        return 0.0
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)
    kept = found.ravel() == 1
    if kept.sum() < 8:
        return _LOST
    lengths = np.linalg.norm((moved - corners).reshape(-1, 2)[kept], axis=1)
    return float(min(np.median(lengths) / max(before.shape), _LOST))


def _open(path: Path) -> Any:
    """The film, upright as its rotation says.

    Raises:
        CaptureError: FFmpeg does not open it, or its frames are too large.
    """
    film = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not film.isOpened():
        raise CaptureError("the video cannot be opened. Convert it to H.264 in MP4")
    film.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
    width, height = (film.get(p) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width * height > MAX_PIXELS:
        raise CaptureError(f"{width:g} x {height:g} pixels; at most {MAX_PIXELS} are read")
    return film


def _write(path: Path, folder: Path, chosen: list[int], side: int) -> list[tuple[int, str]]:
    """Decode the film again and write the chosen frames."""
    film = _open(path)
    written: list[tuple[int, str]] = []
    wanted = set(chosen)
    for number in range(max(chosen) + 1):
        if not film.grab():
            break
        if number not in wanted:
            continue
        done, frame = film.retrieve()
        if done:
            name = f"f{number:05d}.png"
            write_png(folder / name, np.ascontiguousarray(_small(frame, side)[..., ::-1]))
            written.append((number, name))
    film.release()
    return written


def _small(frame: Any, side: int) -> U8:
    height, width = frame.shape[:2]
    scale = side / max(height, width)
    if scale >= 1:
        return np.asarray(frame, np.uint8)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), np.uint8)


def _gray(frame: Any, side: int) -> U8:
    return np.asarray(cv2.cvtColor(_small(frame, side), cv2.COLOR_BGR2GRAY), np.uint8)
