"""Which reader a capture needs; all give the same thing."""

from dataclasses import dataclass, replace

from refdgs_pipe.artifacts.capture import Frame, Layout, named_frames
from refdgs_pipe.artifacts.views import KnownPoints, Skipped
from refdgs_pipe.datasets.blender import read_blender
from refdgs_pipe.datasets.colmap import read_colmap
from refdgs_pipe.datasets.nerfstudio import read_nerfstudio
from refdgs_pipe.datasets.nero import read_nero
from refdgs_pipe.datasets.splits import Split, with_split


@dataclass(frozen=True)
class Found:
    """What a capture holds, before any pixel is decoded.

    Args:
        may_hold_out: the capture has no test views of its own.
        from_first: holding out begins with the first photo, as Ref-Real's and GlossyReal's
            evaluations do, not in the middle of the first gap.
        notes: what the user should know.
    """

    frames: list[Frame]
    skipped: list[Skipped]
    points: KnownPoints | None = None
    may_hold_out: bool = True
    from_first: bool = False
    notes: tuple[str, ...] = ()


def read_capture(layout: Layout, split: Split = "auto") -> Found:
    """List the photos of a capture, with masks and poses where it has them.

    Args:
        split: which views to hold out; "auto": as the data set's authors do, if it has authors.

    Raises:
        InputError: its files of known poses are damaged, a lens cannot be undistorted, or the
            split does not fit.
        CorruptError: its COLMAP model or a camera's pickle is damaged.
    """
    found = _read(layout)
    if layout.kind == "nero" and split == "auto":
        split = "nero"
    if split == "auto":
        return found
    frames, note = with_split(found.frames, split)
    return replace(found, frames=frames, may_hold_out=False, notes=(note,) if note else ())


def _read(layout: Layout) -> Found:
    if layout.kind == "blender":
        frames, skipped = read_blender(layout)
        return Found(frames, skipped, may_hold_out=False)
    if layout.kind == "nerfstudio":
        frames, skipped = read_nerfstudio(layout)
        return Found(frames, skipped, may_hold_out=all(f.split == "train" for f in frames))
    if layout.kind == "nero":
        return Found(*read_nero(layout))
    if layout.kind == "colmap":
        return Found(*read_colmap(layout), from_first=True)
    return Found(named_frames(layout.root, [Frame(path) for path in layout.photos]), [])
