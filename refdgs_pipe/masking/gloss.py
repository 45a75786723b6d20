"""Whether the plane that the object stands on is glossy.

A varnished table adds the light of windows and walls to its own colours, in each photo at another
place. But it is the same light wherever rays are mirrored to the same place of the room. So a
picture of the room can be found: what photos show beyond the plane's own colours is a quantile over
all places and photos that mirror one direction. Photos of a glossy plane agree far better without
it, photos of a matte one do not.
"""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import F64, Camera
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32, Shot, mapped
from refdgs_pipe.mirrored import Room

Ints = NDArray[np.int64]

CELLS = 128  # of the plane's picture, along an edge
BINS = 96  # of the room's picture, along an edge
ROOMS = (None, 16.0, 8.0, 4.0)  # ball radii: how far away the room may be
TURNS = 4
OWN, MIRRORED = 0.3, 0.35  # quantiles: what adds to a colour is never negative, bodies are outliers
FEWEST, PHOTOS = 12, 2  # samples, and photos, that tell of one direction
FLOOR = 0.02  # linear, keeps logarithms finite
GAIN = 0.85  # of the differences between photos, that are left at most


def is_glossy(
    shots: list[Shot], ball: Ball, plane: tuple[F64, float], reach: float, threads: int = 1
) -> bool:
    """Whether photos agree clearly better on a plane after what it mirrors is taken away.

    Args:
        shots: whole photos under a light that stands still, small ones are enough.
        ball: of the object; plane: unit normal and offset, world.
        reach: how far the plane is looked at, world units.
        threads: photos that are worked on at a time; the result does not depend on it.
    """
    ground = Ground.under(ball, *plane, reach)
    place = ((np.mgrid[0:CELLS, 0:CELLS] + 0.5) / CELLS * 2 - 1) * reach
    points = ground.origin + place[1][..., None] * ground.a + place[0][..., None] * ground.b
    points = points.reshape(-1, 3)

    def flat(shot: Shot) -> F32:
        linear = np.where(shot.valid[..., None], linear_from_srgb(shot.rgb), np.float32(np.nan))
        picture = ground.flattened(linear.astype(np.float32), shot.camera, CELLS)
        return np.asarray(picture.reshape(-1, 3), np.float32)

    seen = np.stack(mapped(flat, shots, threads))
    before = _differences(seen, np.zeros_like(seen))
    for away in ROOMS:
        room = None if away is None else Room(ball.center, away * ball.radius)
        keys = np.stack([_keys(points, shot.camera, ground, room) for shot in shots])
        if _left(seen, keys) < GAIN * before:
            return True
    return False


def _left(seen: F32, keys: Ints) -> float:
    """The differences between photos, as from `_differences`, without what the plane mirrors.

    The room's picture, and the plane's own colours, are found by turns.

    Args:
        seen: (N, P, 3) linear RGB of the plane's cells in each photo, NaN where it shows none.
        keys: (N, P) the place in the room's picture that each mirrors.
    """
    light = np.zeros((BINS * BINS, 3), np.float32)
    there = np.isfinite(seen[..., 0])
    rows, photo = keys[there], np.nonzero(there)[0]
    order = np.lexsort((photo, rows))
    rows, photo = rows[order], photo[order]
    starts = np.flatnonzero(np.r_[True, rows[1:] != rows[:-1]])
    sizes = np.diff(np.r_[starts, len(rows)])
    new = np.r_[True, (rows[1:] != rows[:-1]) | (photo[1:] != photo[:-1])]
    photos = np.add.reduceat(new.astype(np.int64), starts)
    told = (sizes >= FEWEST) & (photos >= PHOTOS)
    for _ in range(TURNS):
        own = _ranked(seen - light[keys], OWN)
        more = (seen - own)[there][order]
        for channel in range(3):
            values = more[:, channel]
            ranked = values[np.lexsort((values, rows))]
            at = starts + (MIRRORED * (sizes - 1)).astype(np.int64)
            light[rows[starts], channel] = np.where(told, np.maximum(ranked[at], 0), 0)
    return _differences(seen, light[keys])


def _differences(seen: F32, veil: F32) -> float:
    """The median difference of what photos show of a place from their median, in logarithms."""
    logs = np.log(np.maximum(seen - veil, 0) + FLOOR)
    return float(np.nanmedian(np.abs(logs - _ranked(logs, 0.5))))


def _ranked(values: F32, share: float) -> F32:
    """(...) a quantile of values (N, ...) along the first axis, without those that are NaN."""
    count = np.isfinite(values).sum(0)
    row = (share * np.maximum(count - 1, 0)).astype(np.int64)
    ranked = np.sort(values, axis=0)  # NaN come last
    return np.asarray(np.take_along_axis(ranked, row[None], axis=0)[0], np.float32)


def _keys(points: F64, camera: Camera, ground: Ground, room: Room | None) -> Ints:
    """(P,) the place in the room's picture that each place of the ground mirrors."""
    normal = np.cross(ground.a, ground.b)
    rays = points - camera.center
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    away = rays - 2 * (rays @ normal)[:, None] * normal
    met = away if room is None else room.met(points, away)
    unit = met @ np.stack([ground.a, ground.b, normal], 1)
    x, y = np.clip(_place(unit).T, 0, BINS - 1).astype(np.int64)
    return np.asarray(y * BINS + x)


def _place(unit: F64) -> F64:
    """(N, 2) places in a picture of the upper half of all directions, of equal area (Lambert)."""
    up = np.maximum(unit[:, 2:], 0)
    flat = unit[:, :2] / np.maximum(np.linalg.norm(unit[:, :2], axis=1, keepdims=True), 1e-12)
    return np.asarray((flat * np.sqrt(1 - up) + 1) / 2 * BINS)
