"""What photos say about light that moves: a background that stands still, a ground that darkens."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.color import linear_from_srgb

F32 = NDArray[np.float32]
STILL = 0.012  # sRGB: a pixel of a still background differs less from the median photo
TEXTURE = 0.03  # sRGB from pixel to pixel: a steeper background would show that it moves
_LIT = 0.1  # sRGB: darker pixels do not tell the exposure
_LEAST_GAIN = 0.1  # of a photo's exposure, in sRGB
AROUND = 1.05  # ball radii: what is farther from the ball's centre is background
_DARK, _BRIGHT = 0.02, 0.9  # linear radiance that is neither noise nor clipped
_FEWEST = 300  # observations of the ground
_MOST = 12_000  # that are used
_PASSES, _ROUNDS = 12, 3  # of centring; of weighing outliers less
_REACH = (0.03, 0.08, 0.13, 0.18, 0.25)  # of the distance: how far the lamp is from the lens
_SIDES = ((0, -1), (1, 0), (-1, 0), (0, 1))  # right and down
# the room's shares of the light that are tried
_ROOMS = (0.0, 0.03, 0.08, 0.15, 0.25, 0.4, 0.6)
Ints = NDArray[np.int64]


def still_share(photos: list[F32], cameras: list[Camera], center: F64, radius: float) -> float:
    """The share of the textured background that stands still over the photos of one ring.

    Args:
        photos: (H, W) grey sRGB in [0, 1], all of one size.
        cameras: theirs, of that size; center, radius: of the object ball.

    Returns:
        0 where the background has no texture that could tell.
    """
    outside = _outside(cameras[0], center, radius)
    stack = _equally_exposed(np.stack(photos), outside)
    median = np.median(stack, axis=0)
    slope = np.maximum(*(np.abs(d) for d in np.gradient(median)))
    # how much every photo varies by itself says where a background could have moved at all
    varied = np.mean([np.maximum(*(np.abs(d) for d in np.gradient(p))) for p in photos], axis=0)
    textured = outside & (varied > TEXTURE)
    if textured.sum() < 0.01 * textured.size:
        return 0.0
    apart = np.median(np.abs(stack - median), axis=0)
    still = textured & (apart < STILL) & (slope > TEXTURE / 2)
    return float(still.sum() / textured.sum())


def _equally_exposed(stack: F32, outside: NDArray[np.bool_]) -> F32:
    """(N, H, W) photos, each multiplied so that its background is as bright as the median's."""
    median = np.median(stack, axis=0)
    lit = outside & (median > _LIT)
    if not lit.any():
        return stack
    gains = np.median(stack[:, lit] / median[lit], axis=1)
    return np.asarray(stack / np.maximum(gains, _LEAST_GAIN)[:, None, None], np.float32)


def _outside(camera: Camera, center: F64, radius: float) -> NDArray[np.bool_]:
    """(H, W) pixels whose rays pass the ball by."""
    rays = camera.pixel_rays().reshape(-1, 3) @ camera.cam_from_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    towards = center - camera.center
    along = rays @ towards
    apart = np.sqrt(np.maximum(towards @ towards - along**2, 0))
    return np.asarray((apart > AROUND * radius).reshape(camera.height, camera.width))


@dataclass(frozen=True)
class Ground:
    """What photos show of the ground, one row for each time that one shows a point.

    Args:
        point, photo: (N,) which it is; radiance: (N,) logarithm of the grey value, linear.
        place: (N, 3) the point in the camera's frame; slope: (N, 3) the ground's normal there.
    """

    point: Ints
    photo: Ints
    radiance: F64
    place: F64
    slope: F64

    @classmethod
    def of(
        cls,
        seen: dict[str, tuple[Ints, F64]],
        cameras: dict[str, Camera],
        points: F64,
        normal: F64,
    ) -> "Ground | None":
        """Those that are neither dark nor clipped; None where too few are.

        Args:
            seen: camera's name -> indices (n,) of points and their grey values (n,), linear.
            points: (P, 3) world, on the ground; normal: (3,) of it.
        """
        parts = []
        for number, (name, (index, grey)) in enumerate(seen.items()):
            good = (grey > _DARK) & (grey < _BRIGHT)
            pose = cameras[name].cam_from_world
            place = points[index[good]] @ pose[:3, :3].T + pose[:3, 3]
            slope = np.broadcast_to(pose[:3, :3] @ normal, place.shape)
            photo = np.full(len(place), number)
            parts.append((index[good], photo, np.log(grey[good]), place, slope))
        if not parts:
            return None
        point, photo, radiance, place, slope = (
            np.concatenate(rows) for rows in zip(*parts, strict=True)
        )
        often = np.flatnonzero(np.bincount(point)[point] >= 3) if len(point) else point
        if len(often) < _FEWEST:
            return None
        often = often[:: max(1, len(often) // _MOST)]
        return cls(point[often], photo[often], radiance[often], place[often], slope[often])

    def received(self, lamp: F64, distance: float, room: float) -> F64:
        """(N,) logarithm of what a lamp at (3,), camera's frame, and the room shed there."""
        towards = lamp - self.place
        square = (towards**2).sum(1)
        cosine = np.abs((towards * self.slope).sum(1)) / np.sqrt(square)
        return np.asarray(np.log(room + (1 - room) * cosine * distance**2 / square + 1e-6))

    def slope_of(self, light: F64) -> tuple[float, float]:
        """How closely radiance follows a light: 1 does, 0 does not; and what is left over.

        The slope b of radiance = a of the point + e of the photo + b light, all logarithms.

        Args:
            light: (N,) of `received`.
        """
        groups, weight, slope, missed = (self.point, self.photo), np.ones(len(light)), 0.0, light
        for _ in range(_ROUNDS):  # glints and shadows are outliers
            v = _centred(self.radiance, groups, weight)
            x = _centred(light, groups, weight)
            slope = float((weight * x * v).sum() / max(float((weight * x * x).sum()), 1e-9))
            missed = np.abs(v - slope * x)
            scale = max(float(np.median(missed)), 1e-3)
            weight = 1 / (1 + (missed / (2 * scale)) ** 2)
        return slope, float(np.median(missed))


def falloff(ground: Ground) -> tuple[float, float]:
    """How closely the ground follows a lamp at the lens, and how much that explains.

    Returns:
        The slope: 1 follows the lamp, 0 does not. And the share of the ground's changes that is
        gone with the lamp: noise and what else changes stay, so it tells a weak lamp from chance.
    """
    slope, left = ground.slope_of(ground.received(np.zeros(3), 1.0, 0.0))
    changes = ground.slope_of(np.zeros(len(ground.point)))[1]
    return slope, 1 - left / max(changes, 1e-9)


def placed_lamp(ground: Ground, distance: float) -> tuple[F64, float]:
    """Where the lamp is in the camera's frame, (3,), and the room's share of the light.

    Of some places above, beside and below the lens, the one that explains the ground best.

    Args:
        distance: of the object, world units.
    """
    best: tuple[float, F64, float] = (np.inf, np.zeros(3), 0.0)
    for right, down in [(0.0, 0.0), *((x * f, y * f) for f in _REACH for x, y in _SIDES)]:
        lamp = distance * np.array([right, down, 0.0])
        for room in _ROOMS:
            slope, missed = ground.slope_of(ground.received(lamp, distance, room))
            cost = missed * (1 + abs(slope - 1))
            if cost < best[0]:
                best = (cost, lamp, room)
    return best[1], best[2]


def _centred(values: F64, groups: tuple[Ints, ...], weight: F64) -> F64:
    """Values less the weighted mean of each group of every kind."""
    out = values.copy()
    totals = [np.maximum(np.bincount(group, weight), 1e-12) for group in groups]
    for _ in range(_PASSES):
        for group, total in zip(groups, totals, strict=True):
            out -= (np.bincount(group, weight * out) / total)[group]
    return out


def grey_of(rgb: F32) -> F64:
    """(H, W) linear luminance, ITU-R BT.709, of an sRGB picture (H, W, 3)."""
    return np.asarray(linear_from_srgb(rgb) @ np.array([0.2126, 0.7152, 0.0722]), np.float64)


def looked_up(grey: F64, at: F64) -> F64:
    """(N,) bilinear values of a picture (H, W) at pixels (N, 2), centres at + 0.5."""
    x, y = (at - 0.5).astype(np.float32).T
    return np.asarray(
        cv2.remap(grey.astype(np.float32), x[:, None], y[:, None], cv2.INTER_LINEAR)[:, 0],
        np.float64,
    )
