"""How well views agree on what a surface mirrors.

A mirror shows the same light wherever it reflects rays into the same direction, as long as what it
shows is far away; and where it reflects them to the same place of the ground. With wrong normals,
views disagree on the light from one direction. So two shapes of a part can be compared by the
pictures alone, although the colours of a mirror tell nothing of its depth.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_LONGEST = 320  # pixels of the pictures that are compared
_ALPHA = 0.9
_FACING = 0.1  # cosine from which a place is seen
_SAME = np.radians(4.0)  # between directions that show the same light
_ASKED = 4000  # samples that are compared with others
_PARTNERS = 5  # samples of other views that a sample is compared with, at least
_REACH = 3.0  # ball radii: ground farther away counts as far
_APART = 10.0  # between directions and places of the ground, as coordinates


@dataclass(frozen=True)
class Glimpse:
    """A small picture of what one camera sees of the surface.

    Args:
        color: (H, W, 3) sRGB; depth: (H, W) camera z, 0 where there is no surface.
    """

    camera: Camera
    color: F32
    depth: F32

    @classmethod
    def of(cls, view: SurfaceMap) -> "Glimpse":
        """A view made smaller."""
        import cv2

        camera = view.camera.fitted(_LONGEST)
        size = (camera.width, camera.height)
        color = cv2.resize(view.color, size, interpolation=cv2.INTER_AREA)
        there = np.where(view.alpha >= _ALPHA, view.depth, 0)
        depth = cv2.resize(there, size, interpolation=cv2.INTER_NEAREST)
        return cls(camera, color, depth)


@dataclass(frozen=True)
class Agreement:
    """How views agree on mirrored light, in sRGB.

    Args:
        misfit: mean difference of a sample from what other views say comes from its direction.
        spread: mean difference of all samples from their median.
        count: samples that other views say something of.
    """

    misfit: float
    spread: float
    count: int


def mirror_agreement(
    points: F64,
    normals: F64,
    glimpses: Iterable[Glimpse],
    *,
    near: float,
    ground: F64 | None = None,
    radius: float = 1.0,
) -> Agreement:
    """How well views agree on the light that a surface would mirror.

    Args:
        points, normals: (N, 3) of the surface, world space; unit normals outwards.
        near: a place is seen where the view's depth is its own but for this, world units.
        ground: (3,) unit normal of the ground through the world's origin, if it is known.
        radius: of the object ball, world units.
    """
    keys, colors, view = [], [], []
    for number, glimpse in enumerate(glimpses):
        rows, color = _seen(points, normals, glimpse, near)
        toward = points[rows] - glimpse.camera.center
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        facing = (toward * normals[rows]).sum(1, keepdims=True)
        keys.append(_keys(points[rows], toward - 2 * facing * normals[rows], ground, radius))
        colors.append(color)
        view.append(np.full(len(rows), number))
    key, seen, owner = (np.concatenate(part) for part in (keys, colors, view))
    if not len(key):
        return Agreement(np.nan, 0.0, 0)
    spread = float(np.abs(seen - np.median(seen, axis=0)).mean())
    asked = np.random.default_rng(0).permutation(len(key))[:_ASKED]
    around = cKDTree(key).query_ball_point(key[asked], 2 * np.sin(_SAME / 2))
    misses = []
    for sample, rows in zip(asked, around, strict=True):
        others = np.asarray(rows)[owner[rows] != owner[sample]]
        if len(others) >= _PARTNERS:
            misses.append(np.abs(np.median(seen[others], axis=0) - seen[sample]).mean())
    misfit = float(np.mean(misses)) if misses else float("nan")
    return Agreement(misfit, spread, len(misses))


def _seen(points: F64, normals: F64, glimpse: Glimpse, near: float) -> tuple[Ints, F64]:
    """The points that a view sees, and their colours there."""
    camera = glimpse.camera
    pixels, depth = camera.project(points)
    toward = camera.center - points
    cosine = (toward * normals).sum(1) / np.maximum(np.linalg.norm(toward, axis=1), 1e-9)
    size = np.array([camera.width, camera.height])
    there = (depth > 0) & (cosine > _FACING) & (pixels >= 0).all(1) & (pixels < size).all(1)
    rows = np.flatnonzero(there)
    column, row = pixels[rows].astype(np.int64).T
    front = glimpse.depth[row, column]
    free = (front > 0) & (np.abs(front - depth[rows]) < near)
    return rows[free], glimpse.color[row[free], column[free]].astype(np.float64)


def _keys(points: F64, away: F64, ground: F64 | None, radius: float) -> F64:
    """(N, 4) coordinates that are near for rays which meet the same: far, or on the ground.

    Args:
        away: (N, 3) unit directions of the mirrored rays.
    """
    keys = np.concatenate([away, np.zeros((len(away), 1))], axis=1)
    if ground is None:
        return keys
    height, falling = points @ ground, away @ ground
    with np.errstate(divide="ignore", invalid="ignore"):
        length = np.where(falling < 0, -height / falling, np.inf)
    place = points + np.where(np.isfinite(length), length, 0)[:, None] * away
    close = np.isfinite(length) & (np.linalg.norm(place, axis=1) < _REACH * radius)
    keys[close, :3] = place[close] / radius
    keys[close, 3] = _APART
    return keys
