"""A JSON for each split: NeRF-synthetic, Shiny Blender, and GlossySynthetic as converted.

GlossySynthetic's `points.ply` is left alone: it was made from the true depth, and a start from it
would be no reconstruction.
"""

import math
from dataclasses import replace

from refdgs_pipe.artifacts.capture import Frame, Layout, named_frames, read_transforms
from refdgs_pipe.artifacts.views import Skipped
from refdgs_pipe.datasets.transforms import posed_frames
from refdgs_pipe.errors import InputError


def read_blender(layout: Layout) -> tuple[list[Frame], list[Skipped]]:
    """Every frame of both splits with its pose, and what is missing.

    Raises:
        InputError: a JSON is damaged, has no focal length, or a pose in it is none.
    """
    frames: list[Frame] = []
    skipped: list[Skipped] = []
    for path in layout.model:
        split = "test" if path.stem.endswith("test") else "train"
        shared = read_transforms(path)
        angle = shared.get("camera_angle_x")
        in_pixels = "fl_x" in shared
        if not in_pixels and not (isinstance(angle, float) and 0 < angle < math.pi):
            raise InputError(
                f"{path}: camera_angle_x is {angle}, expected radians in (0, pi), or fl_x in pixels"
            )
        found, missing = posed_frames(path, layout.root, shared)
        frames += [replace(frame, split=split) for frame in found]
        skipped += missing
    return named_frames(layout.root, frames), skipped
