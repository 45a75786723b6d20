"""What goes to the child process that runs COLMAP."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from refdgs_pipe.artifacts.placement import Attempt, Evidence, Placement, Poses
from refdgs_pipe.camera import F64

OnProgress = Callable[[str, int, int | None], None]
# The poses, and what was found out about the capture, in sentences.
Found = tuple[Poses, tuple[str, ...]]

DOUBLED_UP_TO = 1000  # px: of smaller photos the finest features are most of what there is

__all__ = [
    "Attempt",
    "Effort",
    "Evidence",
    "Found",
    "OnProgress",
    "Placement",
    "Posed",
    "Poses",
    "Shots",
]


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
class Posed:
    """A photo whose place came with the capture.

    Args:
        file: name below the image folder; width, height: pixels of that picture.
        lens: (12,) fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6, for that picture.
        cam_from_world: (4, 4).
    """

    file: str
    width: int
    height: int
    lens: tuple[float, ...]
    cam_from_world: F64


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

    def for_photos(self, sizes: Mapping[str, tuple[int, int]]) -> "Effort":
        """The same with a number as `first_octave`: small photos are doubled.

        Args:
            sizes: width and height of each photo, pixels.
        """
        if self.first_octave is not None:
            return self
        is_small = max(max(size) for size in sizes.values()) <= DOUBLED_UP_TO
        return replace(self, first_octave=-int(is_small))
