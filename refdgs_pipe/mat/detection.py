"""Finding the mat's markers in photos."""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64
from refdgs_pipe.color import linear_from_srgb, srgb_from_linear
from refdgs_pipe.files.images import Pixels, read_png
from refdgs_pipe.mat.edges import sharpened
from refdgs_pipe.mat.layout import Paper, mat_of

U8 = NDArray[np.uint8]

DOUBLED_UP_TO = 1200  # px of the long side; in smaller photos markers are small too
LEAST_CELL = 2.0  # px: a smaller cell of a marker is read by chance
FLAT = 0.04  # part of the mat's size that lens and paper may bend it by


@dataclass(frozen=True)
class Seen:
    """The mat's markers in one photo.

    Args:
        paper: which mat it is.
        ids: (n,) marker ids, rising; corners: (n, 4, 2) pixels, centre of the first pixel at 0.5.
    """

    paper: Paper
    ids: NDArray[np.int64]
    corners: F64

    def on_mat(self, corners: dict[int, F64]) -> F64:
        """(4n, 3) the same corners on the mat; `corners` as `Mat.corners` gives them."""
        return np.concatenate([corners[int(i)] for i in self.ids])

    def pixels(self) -> F64:
        """(4n, 2) the corners in the order of `on_mat`."""
        return self.corners.reshape(-1, 2)


def seen_in_files(
    folder: Path, files: Iterable[str], *, threads: int, color_space: str = "srgb"
) -> dict[str, Seen]:
    """The photos that show the mat: file name -> its markers.

    Args:
        folder: where the PNGs are.
        color_space: "srgb" or "linear".

    Raises:
        CorruptError: an image is missing or damaged.
    """
    names = sorted(files)

    def look(name: str) -> Seen | None:
        return seen_in(eight_bit_grey(read_png(folder / name), color_space))

    with ThreadPoolExecutor(max(1, threads)) as pool:
        found = zip(names, pool.map(look, names), strict=True)
        return {name: seen for name, seen in found if seen is not None}


def eight_bit_grey(pixels: Pixels, color_space: str) -> U8:
    """(H, W) grey, sRGB-encoded, of a view's image (H, W) or (H, W, 3), 8 or 16 bits."""
    if pixels.ndim == 3:
        pixels = np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY))
    if color_space == "linear":
        unit = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
        return np.asarray(np.round(srgb_from_linear(unit) * 255), np.uint8)
    return (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels.astype(np.uint8)


def seen_in(grey: U8) -> Seen | None:
    """The markers of our mats in a photo (H, W), sRGB-encoded; None if there are none.

    A marker counts once a photo, its cells have to be large enough to be read, and all markers
    have to lie as on the one mat that most of them belong to.
    """
    photo, scale = grey, 2 if max(grey.shape) <= DOUBLED_UP_TO else 1
    if scale == 2:
        grey = np.asarray(cv2.resize(grey, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC))
    quads, ids, _ = _detector().detectMarkers(grey)
    if ids is None:
        return None
    numbers = [int(i) for i in np.ravel(ids)]
    once = {i: np.asarray(q, np.float64).reshape(4, 2) for i, q in zip(numbers, quads, strict=True)}
    once = {i: q for i, q in once.items() if numbers.count(i) == 1 and _readable(q)}
    linear = linear_from_srgb(photo.astype(np.float32) / np.float32(255))
    sharp = {i: sharpened(linear, (q + 0.5) / scale) for i, q in sorted(once.items())}
    best: dict[int, F64] = {}
    paper: Paper = "a4"
    for name in get_args(Paper):
        corners = mat_of(name).corners()
        candidates = {i: q for i, q in sharp.items() if q is not None and i in corners}
        found = _as_on_mat(candidates, corners)
        if len(found) > len(best):
            best, paper = found, name
    if not best:
        return None
    return Seen(paper, np.array(list(best), np.int64), np.stack(list(best.values())))


def _detector() -> Any:
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    settings.cornerRefinementMaxIterations = 50
    settings.cornerRefinementMinAccuracy = 0.005
    settings.relativeCornerRefinmentWinSize = 0.5
    settings.adaptiveThreshWinSizeMax = 43
    settings.minMarkerPerimeterRate = 0.02
    settings.perspectiveRemovePixelPerCell = 8
    settings.errorCorrectionRate = 0.4
    book = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_ARUCO_MIP_36h12)
    return cv2.aruco.ArucoDetector(book, settings)


def _readable(quad: F64) -> bool:
    """Whether the narrowest side of a marker has enough pixels for its eight cells."""
    sides = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1)
    return bool(sides.min() >= 8 * LEAST_CELL)


def _as_on_mat(found: dict[int, F64], corners: dict[int, F64]) -> dict[int, F64]:
    """Those markers that one plane seen through one lens can show; a single one is believed."""
    if len(found) < 2:
        return found
    flat = np.concatenate([corners[i][:, :2] for i in found])
    pixels = np.concatenate(list(found.values()))
    reach = FLAT * float(np.ptp(pixels, axis=0).max())
    plane, _ = cv2.findHomography(flat, pixels, cv2.RANSAC, reach)
    if plane is None:
        return {}
    shown = cv2.perspectiveTransform(flat[None], plane)[0]
    good = (np.linalg.norm(shown - pixels, axis=1) < reach).reshape(-1, 4).all(axis=1)
    return {i: q for (i, q), keep in zip(found.items(), good, strict=True) if keep}
