"""A picture of the light that the ground sends, from the photos that show it."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.ndimage import label

from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import F64
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.ground.plane import Ground
from refdgs_pipe.ground.shots import F32, LOG_FLOOR, grown
from refdgs_pipe.ground_light import GroundLight

REACH = 4.0  # ball radii from the middle
LONGEST = 1000  # pixels of the photos that are looked at
CELLS = 512  # along an edge of the picture
MOST = 48  # photos, spread over all: more hardly change a median
FEWEST = 3  # of them that have to show a place
ALIKE = 0.2  # of log radiance, within which they agree
AGREEING = (0.3, 0.6)  # share of them: from nothing known to fully known
EDGE = 0.01  # of the photo's longer side, round the object, that is left out
OBJECT = 0.02  # of the mask, from which a pixel may show some of it
NEAR_ENOUGH = 0.05  # share of known places in a blur, from which it fills a hole
LEAST = 0.02  # share of the picture that has to be known


@dataclass(frozen=True)
class Exposed:
    """A photo, and the factor of its linear radiance that makes it as bright as the others."""

    photo: Photo
    factor: float


def ground_radiance(
    shown: Iterable[Exposed], ball: Ball, plane: tuple[F64, float]
) -> GroundLight | None:
    """The light that the ground below an object sends, or None where photos do not tell it.

    Where they do not agree the ground shines, a shadow moves, or something stands on it: nothing
    is said there.

    Args:
        shown: with masks; those without one tell nothing.
        plane: unit normal and offset, world.
    """
    ground = Ground.under(ball, *plane, REACH * ball.radius)
    stack = [_flattened(one, ground) for one in shown if one.photo.mask is not None]
    if len(stack) < FEWEST:
        return None
    seen = np.stack(stack)
    count = np.isfinite(seen[..., 0]).sum(0)
    some = count >= FEWEST
    if some.mean() < LEAST:
        return None
    color = np.zeros((CELLS, CELLS, 3), np.float32)
    color[some] = torch.from_numpy(seen[:, some]).nanmedian(0).values.numpy()
    logs = np.log(color + LOG_FLOOR)
    near = sum((np.abs(np.log(one + LOG_FLOOR) - logs).max(-1) < ALIKE).astype(int) for one in seen)
    share = np.where(some, near / np.maximum(count, 1), 0)
    known = np.clip((share - AGREEING[0]) / (AGREEING[1] - AGREEING[0]), 0, 1).astype(np.float32)
    if (known > 0).mean() < LEAST:
        return None
    picture = _without_holes(np.dstack([color * known[..., None], known]))
    return GroundLight(picture, ground.origin, ground.a, ground.b, ground.radius)


def _without_holes(picture: F32) -> F32:
    """(CELLS, CELLS, 4) the picture, with what the object hides filled from around it.

    Places of the object just above the ground mirror the ground beside the hidden part; from
    higher up, the hidden part is behind the object.

    Args:
        picture: as `GroundLight` has it.
    """
    known = picture[..., 3] > 0.5
    parts, _ = label(~known)
    outside = np.unique(np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]]))
    hole = ~known & ~np.isin(parts, outside)
    around, found = np.where(hole[..., None], 0, picture).astype(np.float32), picture.copy()
    todo, width = hole, 1.0
    while todo.any() and width < CELLS:
        wide = cv2.GaussianBlur(around, (0, 0), width)
        now = todo & (wide[..., 3] > NEAR_ENOUGH)
        found[now] = wide[now] / wide[now][:, 3:]
        todo, width = todo & ~now, 2 * width
    return found


def _flattened(shown: Exposed, ground: Ground) -> F32:
    """(CELLS, CELLS, 3) linear radiance of the ground in one photo; NaN where it shows none."""
    photo = shown.photo
    assert photo.mask is not None
    edge = max(2, round(EDGE * max(photo.mask.shape)))
    free = photo.valid & ~grown(photo.mask > OBJECT, edge)
    linear = linear_from_srgb(photo.rgb) * np.float32(shown.factor)
    kept = np.where(free[..., None], linear, np.float32(np.nan)).astype(np.float32)
    return ground.flattened(kept, photo.camera, CELLS)
