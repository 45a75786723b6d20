"""The lattice of a repeating ground (checks, tiles, dots) in one photo.

Points that look like each other and repeat give a first cell of four; the homography from cells to
pixels grows from it node by node (as in Park, Brocklehurst, Collins and Liu 2009), and the growth
that fills most of the photo with nodes is kept.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refdgs_pipe.camera import F64
from refdgs_pipe.vectors import root_sift

U8 = NDArray[np.uint8]
Ints = NDArray[np.int64]

MOST_KEYS = 1500  # of a photo, the strongest
LEAST_SIZE = 3.5  # px, of a keypoint
ALIKE = 0.45  # radians between descriptors of two repeats
NEAR, FAR = 8.0, 160.0  # px between repeats, in photos of 640 px
SEEDS = 150  # keypoints that a growth is tried from
GROWTHS = 3  # from each
OFF_NODE = 0.15  # of a cell: how far a keypoint lies from its node
REACH, WIDER = 1.6, 1.35  # cells of the first growth; factor of each next one
ROUNDS = 14
LEAST_NODES = 9
LEAST_RECALL = 0.4  # of the nodes in the hull


@dataclass(frozen=True)
class Lattice:
    """A lattice in one photo.

    Args:
        pixels_from_cells: (3, 3) homography.
        nodes: (n, 2) cells of the nodes that were found, whole numbers after `find_lattice`.
        pixels: (n, 2) where, centre of the first pixel at 0.5.
    """

    pixels_from_cells: F64
    nodes: F64
    pixels: F64

    def in_basis(self, basis: F64) -> "Lattice":
        """The same ground, its cells spanned by the columns of `basis` (2, 2), in old cells."""
        wide = np.eye(3)
        wide[:2, :2] = basis
        nodes = np.asarray(np.linalg.solve(basis, self.nodes.T).T, np.float64)
        return Lattice(self.pixels_from_cells @ wide, nodes, self.pixels)

    def moved(self, by: F64) -> "Lattice":
        """The same ground, its cells counted from elsewhere: new = old + by (2,)."""
        back = np.eye(3)
        back[:2, 2] = -by
        return Lattice(self.pixels_from_cells @ back, self.nodes + by, self.pixels)


def mapped(homography: F64, points: F64) -> F64:
    """(n, 2) the points (n, 2) through a homography (3, 3)."""
    found = np.concatenate([points, np.ones((len(points), 1))], 1) @ homography.T
    return np.asarray(found[:, :2] / found[:, 2:])


def find_lattice(grey: U8) -> Lattice | None:
    """The lattice that fills most of a photo (H, W), sRGB-encoded; None without one.

    Its first basis vector turns clockwise to the second, as seen in the photo.
    """
    scale = max(grey.shape) / 640
    points, looks = _keys(grey, scale)
    if len(points) < LEAST_NODES:
        return None
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) / scale
    alike = (np.arccos(np.clip(looks @ looks.T, -1, 1)) < ALIKE) & (apart > NEAR)
    count = (alike & (apart < FAR)).sum(1).astype(float)
    if not count.any():
        return None
    rng = np.random.default_rng(0)
    best: tuple[float, Lattice] | None = None
    for seed in rng.choice(len(points), SEEDS, p=count / count.sum()):
        near = np.flatnonzero(alike[seed] & (apart[seed] < FAR))
        near = near[np.argsort(apart[seed][near], kind="stable")][:10]
        members = points[alike[seed] | (np.arange(len(points)) == seed)]
        for first in _first_cells(points[seed], points[near], members):
            found = _grown(first, members, scale)
            if found is None:
                continue
            recall = min(1.0, _recall(found.nodes))
            figure = len(found.nodes) * np.sqrt(_area(found.pixels)) * recall**2
            if recall > LEAST_RECALL and (best is None or figure > best[0]):
                best = figure, found
    if best is None or len(best[1].nodes) < LEAST_NODES:
        return None
    return best[1]


def _keys(grey: U8, scale: float) -> tuple[F64, NDArray[np.float32]]:
    """Places of keypoints and unit descriptors (RootSIFT), all upright: repeats are not turned."""
    sift = cv2.SIFT.create(0, 3, 0.02, 10, 1.6)
    seen: dict[tuple[int, int, int], cv2.KeyPoint] = {}
    for key in sift.detect(grey, None):
        if key.size >= LEAST_SIZE * scale:
            key.angle = 0.0
            seen.setdefault((round(key.pt[0]), round(key.pt[1]), round(key.size)), key)
    keys = sorted(seen.values(), key=lambda key: -key.response)[:MOST_KEYS]
    if not keys:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    found, looks = sift.compute(grey, keys)
    return np.array([key.pt for key in found], float) + 0.5, root_sift(looks)


def _first_cells(seed: F64, near: F64, members: F64) -> list[F64]:
    """Homographies (3, 3) from cells to pixels of some cells of four at the seed (2,)."""
    tree, cells = cKDTree(members), []
    for i in range(len(near)):
        for j in range(i + 1, len(near)):
            a, b = near[i] - seed, near[j] - seed
            sides = float(np.linalg.norm(a)), float(np.linalg.norm(b))
            cross = float(a[0] * b[1] - a[1] * b[0])
            if abs(cross) < 0.3 * sides[0] * sides[1]:
                continue
            a, b = (a, b) if cross > 0 else (b, a)
            off, which = tree.query(np.stack([seed + a + b, seed - a, seed - b]))
            close = off < 0.2 * min(sides)
            if not close[0] or not close[1:].any():
                continue
            corners = np.stack([seed, seed + a, seed + b, members[which[0]]])
            square = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
            cell = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
            cells.append(np.asarray(cell, float))
            if len(cells) == GROWTHS:
                return cells
    return cells


def _grown(homography: F64, points: F64, scale: float) -> Lattice | None:
    """The lattice after it grew from its first cell over these points (n, 2)."""
    reach, best = REACH, None
    for step in range(ROUNDS):
        if not np.isfinite(homography).all() or abs(np.linalg.det(homography)) < 1e-12:
            return None
        cells = mapped(np.asarray(np.linalg.inv(homography), np.float64), points)
        near = np.round(cells)
        there = mapped(homography, near)
        sides = [np.linalg.norm(mapped(homography, near + s) - there, axis=1) for s in np.eye(2)]
        off, smaller = np.linalg.norm(there - points, axis=1), np.minimum(*sides)
        good = (np.abs(cells).max(1) < reach) & (off < OFF_NODE * smaller)
        good &= (smaller > 6 * scale) & (np.maximum(*sides) < 200 * scale)
        rows = np.flatnonzero(good)
        rows = rows[np.argsort(off[rows], kind="stable")]
        rows = rows[np.unique(near[rows], axis=0, return_index=True)[1]]
        nodes = near[rows]
        if len(nodes) < 5 or (np.ptp(nodes, axis=0) < 1).any():
            return None
        fitted, _ = cv2.findHomography(nodes, points[rows], 0)
        if fitted is None:
            return None
        homography = np.asarray(fitted, float)
        best = Lattice(homography, nodes, points[rows])
        reach *= WIDER if step else 1.0
    return best


def _area(pixels: F64) -> float:
    """Square pixels in the hull of points (n, 2).

    A table fills more of a photo than the floor behind it, though the floor may show more cells.
    """
    return float(cv2.contourArea(cv2.convexHull(pixels.astype(np.float32))))


def _recall(nodes: F64) -> float:
    """Share of the nodes in the hull of the found ones (n, 2) that were found."""
    hull = cv2.convexHull(nodes.astype(np.float32))
    # Pick's theorem: whole points inside and on the rim
    area = float(cv2.contourArea(hull))
    corners = hull[:, 0].astype(int)
    rim = sum(
        int(np.gcd(*np.abs(b - a))) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)
    )
    return len(nodes) / max(area + rim / 2 + 1, 1.0)
