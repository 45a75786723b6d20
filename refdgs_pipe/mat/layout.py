"""The mat that an object stands on: where its markers are, in millimetres on paper."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from refdgs_pipe.camera import F64

Paper = Literal["a4", "letter"]

LINE_MM = 180.0  # length of the ruler line
MARGIN = 9.0  # mm from the paper's edge to the markers; printers leave 3 to 6 mm blank
BLANK = 5.5  # mm that nothing is drawn on
QUIET = 3.5  # mm of white round a marker
LARGE, SMALL = 26.0, 14.0  # sides of the markers, mm
STRIP = 12.0  # height of the strip with the ruler line, mm


@dataclass(frozen=True)
class Marker:
    """One marker of the dictionary DICT_ARUCO_MIP_36h12.

    Args:
        x, y: its centre, mm from the paper's lower left corner; side: mm.
    """

    id: int
    x: float
    y: float
    side: float


@dataclass(frozen=True)
class Mat:
    """A sheet in landscape format.

    Args:
        width, height: of the paper, mm.
        stretch: what the printer made of a millimetre; 1 on paper that was printed at 100 %.
    """

    paper: Paper
    width: float
    height: float
    markers: tuple[Marker, ...]
    stretch: float = 1.0

    @property
    def line(self) -> tuple[float, float, float]:
        """Left end, right end and height of the ruler line, mm from the lower left corner."""
        left = (self.width - LINE_MM) / 2
        return left, left + LINE_MM, MARGIN + LARGE + QUIET + 0.6 * STRIP

    def corners(self) -> dict[int, F64]:
        """Marker id -> (4, 3) corners in metres.

        The origin is the middle of the paper, x to the right, y away from the ruler line, z up.
        The order is that of OpenCV: upper left, upper right, lower right, lower left.
        """
        square = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
        middle = np.array([self.width / 2, self.height / 2, 0])
        metre = 1e-3 * self.stretch
        return {
            m.id: (m.side * square + np.array([m.x, m.y, 0]) - middle) * metre for m in self.markers
        }


def mat_of(paper: Paper, *, line_mm: float = LINE_MM) -> Mat:
    """The mat for a paper size.

    Args:
        line_mm: the ruler line's length as measured on the printed sheet.
    """
    first_id = {"a4": 0, "letter": 60}[paper]  # each paper has ids of its own: photos tell which
    width, height = {"a4": (297.0, 210.0), "letter": (279.4, 215.9)}[paper]
    places = _rim(width, height) + _inner(width, height)
    markers = (Marker(first_id + i, *place) for i, place in enumerate(places))
    return Mat(paper, width, height, tuple(markers), line_mm / LINE_MM)


def _rim(width: float, height: float) -> list[tuple[float, float, float]]:
    """(x, y, side) of the large markers along the edges: seven by five."""
    edge = MARGIN + LARGE / 2
    xs, ys = np.linspace(edge, width - edge, 7), np.linspace(edge, height - edge, 5)
    rows = [(float(x), float(y), LARGE) for y in (ys[0], ys[-1]) for x in xs]
    return rows + [(float(x), float(y), LARGE) for x in (xs[0], xs[-1]) for y in ys[1:-1]]


def _inner(width: float, height: float) -> list[tuple[float, float, float]]:
    """(x, y, side) of the small markers inside the rim, for photos from near."""
    x = MARGIN + LARGE + 2 * QUIET + SMALL / 2
    top, low = height - x, x + STRIP
    places = [(x, top), (width / 2, top), (width - x, top), (x, low), (width - x, low)]
    return [(x, y, SMALL) for x, y in places]
