"""Sizes at which masks are looked for, one after the other."""

from dataclasses import dataclass

from refdgs_pipe.masking.table import BLUR, Blur


@dataclass(frozen=True)
class Level:
    """One size of working.

    Args:
        side: longest side of the photos, pixels.
        cells: along an edge of the plane's picture.
        solid: cells along an edge of the solid's grid.
        denials: for each round the share of the photos that may deny a cell.
        margin: round the object that photos are cut to, a share of its size.
        growth: cells by which a mask is widened before it denies.
        weight: of the evidence against the outline, for a pixel of a photo 400 pixels long.
        blur: of the evidence of the plane.
    """

    side: int
    cells: int
    solid: int
    denials: tuple[float, ...]
    margin: float
    growth: float
    weight: float
    blur: Blur = BLUR


LEVELS = (
    Level(200, 256, 64, (0.25, 0.15), 0.0, 0.9, 0.4),
    Level(400, 384, 96, (0.08, 0.06), 0.5, 0.9, 0.4),
)
LAST = Level(1024, 512, 112, (0.08, 0.06), 0.2, 0.25, 0.25, (0.5, 1.3))
