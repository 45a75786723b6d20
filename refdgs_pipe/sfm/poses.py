"""What goes to the child process that runs COLMAP."""

from collections.abc import Callable
from dataclasses import dataclass

from refdgs_pipe.artifacts.placement import Attempt, Evidence, Placement, Poses

OnProgress = Callable[[str, int, int | None], None]

__all__ = ["Attempt", "Effort", "Evidence", "OnProgress", "Placement", "Poses", "Shots"]


@dataclass(frozen=True)
class Shots:
    """Photos taken through one lens.

    Args:
        files: names below the image folder.
        focal: pixels, or None if EXIF does not tell.
    """

    files: tuple[str, ...]
    width: int
    height: int
    focal: float | None


@dataclass(frozen=True)
class Effort:
    """How hard to look for features.

    Args:
        max_side: pixels that larger photos are reduced to; max_features: of one photo.
        first_octave: -1 doubles the photos first; None does so for small ones, where the finest
            features are most of what there is: on 640 pixels it halves the error of the poses.
        threads: changes the time, not the result.
        faint: also features of low contrast, as on plain glossy surfaces.
        affine: shape and scale of each feature are adapted to steep views, and matches are looked
            for again along the epipolar lines. Some five times slower.
    """

    max_side: int
    max_features: int
    first_octave: int | None
    threads: int
    faint: bool = False
    affine: bool = False
