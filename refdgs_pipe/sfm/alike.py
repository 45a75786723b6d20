"""Whether photos that were placed close together show the same.

Where an object has equal sides, photos of different sides can get the same place, and all their
matches agree. What differs between the sides has no match (missing correspondences: Zach, Irschara
and Bischof 2008). So the points that one photo sees and the other has no match for are looked up
in both. If the places are right, both show the same pattern there, equally lit. Where even the
matched points do not look alike, false matches made the pair seem close, and it tells nothing.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import F64, Camera

Ints = NDArray[np.int64]

CLOSE_DEG = 15.0  # between two photos, as `_Pair.angle` has it
SHARED = 10  # points that two photos have to share
SIDE = 800  # pixels, of the photos that are compared
NARROW_DEG = 10.0  # between which and CLOSE_DEG the object hides much of what both could show
ENOUGH = 6  # pairs, from which on such wide ones are not compared
NEAR_DEG = 8.0  # the same between photos that see the same light
MOST_PAIRS = 60  # that are compared, the closest first
MOST_POINTS = 150  # of a photo, looked up in another
FEWEST_POINTS = 15
FEWEST_ALIKE = 8  # of these, to say how many of them are lit otherwise
HALF = 6  # pixels, of a patch
CONTRAST = 0.016  # standard deviation of a patch that tells anything, sRGB
LIKE = 0.5  # correlation of two patches that show the same
MATCHED = 0.5  # share of the points that both see, which look alike where such a pair can tell
LIT = 0.25  # difference of the logarithms of their light, beside that of the shared points
SHARPER = 1.6  # times the contrast of what both see: such photos are not equally sharp
AS_FAR = 1.3  # times: what a photo from farther away sees is hidden from the nearer one
FLOOR = 0.01  # added to linear light before its logarithm


@dataclass(frozen=True)
class Agreement:
    """What was found in the pairs of close photos.

    Args:
        pairs: ordered pairs that could be compared.
        share: of the points without a match, that look alike in both photos: the lower quartile
            over the pairs; NaN without pairs.
        near: of these pairs, those that are nearer to each other still.
        uneven: how unequally the points that both see are lit in one photo and the other: median
            deviation of the logarithms' difference, median over the near pairs; NaN without these.
        told: near pairs in which points without a match look alike.
        other_light: of these points, the share that is lit otherwise than the points that both
            see: median over these pairs; NaN without them.
    """

    pairs: int
    share: float
    near: int
    uneven: float
    told: int
    other_light: float


def agreement(model: SparseModel, views: Views) -> Agreement:
    """Compare the photos that were placed close together, the closest pairs first."""
    pictures = _Pictures(views, model)
    shares: list[float] = []
    uneven: list[float] = []
    otherwise: list[float] = []
    for pair in _close(model)[:MOST_PAIRS]:
        if pair.angle >= NARROW_DEG and len(shares) >= ENOUGH:
            break
        light, like, contrast = pictures.compared(pair.one, pair.other, model.points[pair.shared])
        if not len(light) or not 1 / SHARPER < np.median(contrast) < SHARPER:
            continue
        if (like > LIKE).mean() < MATCHED:
            continue
        if pair.farther < AS_FAR:
            apart, like, _ = pictures.compared(pair.one, pair.other, model.points[pair.rest])
            if len(like) >= FEWEST_POINTS:
                lit, same = np.abs(apart - np.median(light)) < LIT, like > LIKE
                shares.append(float((lit & same).mean()))
                if pair.angle < NEAR_DEG and same.sum() >= FEWEST_ALIKE:
                    otherwise.append(float((same & ~lit).sum() / same.sum()))
        if pair.angle < NEAR_DEG:
            uneven.append(float(np.median(np.abs(light - np.median(light)))))
    return Agreement(
        len(shares),
        float(np.quantile(shares, 0.25)) if shares else float("nan"),
        len(uneven),
        float(np.median(uneven)) if uneven else float("nan"),
        len(otherwise),
        float(np.median(otherwise)) if otherwise else float("nan"),
    )


def times_as_far(one: Camera, other: Camera, points: F64) -> float:
    """How many times as far as the other camera the first is from points (n, 3), in the median."""
    away = [np.linalg.norm(points - camera.center, axis=1) for camera in (one, other)]
    return float(np.median(away[0] / np.maximum(away[1], 1e-12)))


def turned_deg(one: Camera, other: Camera, middle: F64) -> float:
    """The angle between the directions from a point to two cameras, degrees."""
    away = np.stack([one.center, other.center]) - middle
    lengths = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
    cosine = float(away[0] @ away[1] / (lengths[0] * lengths[1]))
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@dataclass(frozen=True)
class _Pair:
    """Two close photos.

    Args:
        angle: between their rays to the points that both see, degrees, in the median; or how far
            the one is turned from the other about the object, where that is more. What both see of
            a far wall lies in nearly the same direction for photos of different sides.
        farther: how many times as far the first is from these points.
        shared, rest: rows of points that both see, and that the first sees alone.
    """

    one: Camera
    other: Camera
    angle: float
    farther: float
    shared: Ints
    rest: Ints


def _close(model: SparseModel) -> list[_Pair]:
    """Ordered pairs of close photos, the closest first."""
    found = []
    for one in model.cameras:
        for other in model.cameras:
            a, b = model.tracks[one.name], model.tracks[other.name]
            shared = np.intersect1d(a, b)
            if one is other or len(shared) < SHARED:
                continue
            rays = [model.points[shared] - camera.center for camera in (one, other)]
            cosine = (rays[0] * rays[1]).sum(1) / np.maximum(
                np.linalg.norm(rays[0], axis=1) * np.linalg.norm(rays[1], axis=1), 1e-12
            )
            angle = float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))))
            angle = max(angle, turned_deg(one, other, model.ball.center))
            if angle < CLOSE_DEG:
                rest = _some(np.setdiff1d(a, b))
                farther = times_as_far(one, other, model.points[shared])
                found.append(_Pair(one, other, angle, farther, _some(shared), rest))
    return sorted(found, key=lambda pair: pair.angle)


def _some(rows: Ints) -> Ints:
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), MOST_POINTS)).astype(int)
    return np.asarray(rows[chosen])


class _Pictures:
    """The photos, small and grey, each read once."""

    def __init__(self, views: Views, model: SparseModel) -> None:
        self.views, self.model = views, model
        self._read: dict[str, tuple[Camera, NDArray[np.float32]]] = {}

    def compared(self, one: Camera, other: Camera, points: F64) -> tuple[F64, F64, F64]:
        """For points that both photos show with some contrast: how much more light the first has
        (difference of logarithms), the correlation of the patches around them, and how many times
        the relative contrast of the first the second has.

        A patch lies in the plane through the point that faces the middle between both cameras.
        """
        if not len(points):
            return np.zeros(0), np.zeros(0), np.zeros(0)
        patches = []
        grid = _grid(one, self._picture(one)[0], (one.center + other.center) / 2, points)
        for camera in (one, other):
            small, grey = self._picture(camera)
            pixels, depth = small.project(grid.reshape(-1, 3))
            x, y = (pixels[:, i].reshape(grid.shape[:2]).astype(np.float32) - 0.5 for i in (0, 1))
            found = cv2.remap(
                grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
            )
            behind = depth.reshape(grid.shape[:2]) <= 0
            patches.append(np.where(behind, np.nan, found).astype(np.float64))
        a, b = patches
        kept = np.isfinite(a).all(1) & np.isfinite(b).all(1)
        a, b = a[kept], b[kept]
        level = [np.maximum(p.mean(1), 1e-3) for p in (a, b)]
        light = [np.log(mean**2.2 + FLOOR) for mean in level]
        a, b = (p - p.mean(1, keepdims=True) for p in (a, b))
        spread = [np.sqrt((p * p).mean(1)) for p in (a, b)]
        like = (a * b).mean(1) / np.maximum(spread[0] * spread[1], 1e-9)
        told = spread[0] > CONTRAST
        contrast = spread[1] * level[0] / (np.maximum(spread[0], 1e-9) * level[1])
        return (light[0] - light[1])[told], like[told], contrast[told]

    def _picture(self, camera: Camera) -> tuple[Camera, NDArray[np.float32]]:
        if camera.name not in self._read:
            scale = min(1.0, SIDE / max(camera.width, camera.height))
            photo = load_photo(self.views, self.model, camera, scale=scale)
            grey = np.where(photo.valid, photo.rgb.mean(-1), np.nan).astype(np.float32)
            self._read[camera.name] = photo.camera, grey
        return self._read[camera.name]


def _grid(camera: Camera, small: Camera, facing: F64, points: F64) -> F64:
    """(n, k, 3) places of patches around points (n, 3), as large as pixels of `small` there."""
    normal = facing - points
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    right = np.cross(normal, camera.cam_from_world[1, :3])
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-12)
    down = np.cross(normal, right)
    pixel = np.linalg.norm(points - camera.center, axis=1) / small.K[0, 0]
    steps = np.arange(-HALF, HALF + 1)
    x, y = (axis.ravel()[None, :, None] for axis in np.meshgrid(steps, steps))
    across = x * right[:, None] + y * down[:, None]
    return np.asarray(points[:, None] + pixel[:, None, None] * across)
