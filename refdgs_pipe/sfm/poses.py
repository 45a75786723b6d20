"""What goes to the child process that runs COLMAP, and what comes back."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64

OnProgress = Callable[[str, int, int | None], None]


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
    """

    max_side: int
    max_features: int
    first_octave: int | None
    threads: int


@dataclass(frozen=True)
class Poses:
    """What was reconstructed, in COLMAP's own frame.

    Args:
        cam_from_world: file name -> (4, 4).
        lens_of: file name -> index into `lenses`.
        lenses: COLMAP model name, width, height and parameters of each lens.
        points: (P, 3); colors: (P, 3) uint8; tracks: file name -> point indices.
        error_px: mean reprojection error.
        mapper: "incremental" or "global".
    """

    cam_from_world: dict[str, F64]
    lens_of: dict[str, int]
    lenses: tuple[tuple[str, int, int, F64], ...]
    points: F64
    colors: NDArray[np.uint8]
    tracks: dict[str, NDArray[np.int64]]
    error_px: float
    mapper: str
