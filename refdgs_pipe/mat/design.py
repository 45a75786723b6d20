"""What is drawn on the mat, as plain shapes: a texture, the markers, the ruler line, words."""

from dataclasses import dataclass

import numpy as np

from refdgs_pipe.camera import F64
from refdgs_pipe.mat.layout import BLANK, LINE_MM, QUIET, STRIP, Mat

SEED = 20
LEAVES = 6000
SIZES = (1.4, 18.0)  # radii of the leaves, mm
GREYS = (0.35, 1.0)
CELLS = 8  # of a marker's side: six bits and the black border
TEXT_MM = 3.2


@dataclass(frozen=True)
class Shape:
    """A filled polygon: (N, 2) mm from the paper's lower left corner; grey 0 is black, 1 white."""

    outline: F64
    grey: float


@dataclass(frozen=True)
class Box:
    """A filled rectangle, mm from the paper's lower left corner."""

    left: float
    low: float
    right: float
    top: float


@dataclass(frozen=True)
class Word:
    """A line of text; x, y is the left end of its base line, mm."""

    x: float
    y: float
    text: str
    height: float = TEXT_MM


def leaves(mat: Mat) -> list[Shape]:
    """The texture: leaves of all sizes that hide each other, every one with a shape of its own.

    Such "dead leaves" have the statistics of natural pictures (Lee, Mumford, Huang 2001): sizes
    follow a power law with exponent 3, so there are features at every distance.
    """
    draw = np.random.RandomState(SEED)  # its stream never changes
    low, high = SIZES
    share = draw.uniform(0, 1, LEAVES)
    radii = 1 / np.sqrt(1 / low**2 + share * (1 / high**2 - 1 / low**2))
    shapes = []
    for radius in radii:
        count = draw.randint(5, 10)
        angles = np.sort(draw.uniform(0, 2 * np.pi, count))
        ring = np.stack([np.cos(angles), np.sin(angles)], 1) * draw.uniform(0.5, 1.2, (count, 1))
        center = draw.uniform(0, 1, 2) * (mat.width, mat.height)
        shapes.append(Shape(center + radius * ring, float(draw.uniform(*GREYS))))
    return shapes


def blank_boxes(mat: Mat) -> list[Box]:
    """What stays white: the paper's edge, round the markers, and behind the ruler line."""
    width, height = mat.width, mat.height
    left, right, y = mat.line
    boxes = [
        Box(0, 0, width, BLANK),
        Box(0, height - BLANK, width, height),
        Box(0, 0, BLANK, height),
        Box(width - BLANK, 0, width, height),
        Box(left - QUIET, y - 0.6 * STRIP, right + QUIET, y + 0.4 * STRIP),
    ]
    for marker in mat.markers:
        reach = marker.side / 2 + QUIET
        x, y = marker.x, marker.y
        boxes.append(Box(x - reach, y - reach, x + reach, y + reach))
    return boxes


def black_cells(mat: Mat) -> list[list[Box]]:
    """For each marker the boxes that are black, without overlap."""
    import cv2

    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_ARUCO_MIP_36h12)
    markers = []
    for marker in mat.markers:
        bits = cv2.aruco.generateImageMarker(book, marker.id, CELLS)
        cell = marker.side / CELLS
        left, top = marker.x - marker.side / 2, marker.y + marker.side / 2
        boxes = []
        for row, column in np.argwhere(bits == 0):
            x, y = left + column * cell, top - row * cell
            boxes.append(Box(x, y - cell, x + cell, y))
        markers.append(boxes)
    return markers


def ruler(mat: Mat) -> list[Box]:
    """The ruler line with its ends and a mark every 10 mm; its length is between outer edges."""
    left, right, y = mat.line
    thin = 0.3
    boxes = [Box(left, y - thin / 2, right, y + thin / 2)]
    boxes += [Box(left, y - 3, left + thin, y + 3), Box(right - thin, y - 3, right, y + 3)]
    for step in range(10, int(LINE_MM), 10):
        boxes.append(Box(left + step - thin / 4, y, left + step + thin / 4, y + 1.5))
    return boxes


def words(mat: Mat) -> list[Word]:
    """What the sheet says to the person who prints it."""
    left, _, y = mat.line
    told = (
        f"Print at 100 %. This line must be {LINE_MM:g} mm long; "
        "if yours is not, run with --set sfm.mat_line=(its length)."
    )
    size = {"a4": "A4", "letter": "Letter"}[mat.paper]
    return [
        Word(left + 2, y - 5.5, told),
        Word(left + 2, y + 2.2, f"refdgs-pipe mat, {size}. Object into the middle", 2.2),
    ]
