"""Which reader a capture needs; all give the same thing."""

from dataclasses import dataclass

from refdgs_pipe.artifacts.capture import Frame, Layout, named_frames
from refdgs_pipe.artifacts.views import KnownPoints, Skipped
from refdgs_pipe.datasets.blender import read_blender
from refdgs_pipe.datasets.colmap import read_colmap
from refdgs_pipe.datasets.nerfstudio import read_nerfstudio


@dataclass(frozen=True)
class Found:
    """What a capture holds, before any pixel is decoded.

    Args:
        may_hold_out: the capture has no test views of its own.
    """

    frames: list[Frame]
    skipped: list[Skipped]
    points: KnownPoints | None = None
    may_hold_out: bool = True


def read_capture(layout: Layout) -> Found:
    """List the photos of a capture, with masks and poses where it has them.

    Raises:
        InputError: its files of known poses are damaged, or a lens cannot be undistorted.
        CorruptError: its COLMAP model is damaged.
    """
    if layout.kind == "blender":
        frames, skipped = read_blender(layout)
        return Found(frames, skipped, may_hold_out=False)
    if layout.kind == "nerfstudio":
        frames, skipped = read_nerfstudio(layout)
        return Found(frames, skipped, may_hold_out=all(f.split == "train" for f in frames))
    if layout.kind == "colmap":
        return Found(*read_colmap(layout))
    return Found(named_frames(layout.root, [(p, None, "train", None) for p in layout.photos]), [])
