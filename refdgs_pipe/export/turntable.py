"""The product from all round, painted and as a net of triangles."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.export.preview import cast, rays_around, reach_around, shade
from refdgs_pipe.export.product import Product
from refdgs_pipe.ray_casting import Hits, at_hits

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

_SUPERSAMPLING = 2
_CLAY = np.array([0.80, 0.82, 0.85], np.float32)  # sRGB
_LINE = np.array([0.05, 0.16, 0.36], np.float32)
_LINE_WIDTH = 0.55  # half of it, in pixels
# How certain the shape is, sRGB: in no photo, a guess, certain; and the inside, through a hole.
UNSEEN = np.array([0.84, 0.19, 0.19], np.float32)
LITTLE = np.array([0.98, 0.75, 0.24], np.float32)
MUCH = np.array([0.12, 0.51, 0.59], np.float32)
INSIDE = np.array([0.75, 0.27, 0.86], np.float32)


@dataclass(frozen=True)
class Turn:
    """Pictures of one side: (side, side, 4) sRGB with straight alpha."""

    painted: U8
    wire: U8


def render_turntable(product: Product, *, count: int, side: int, threads: int = 1) -> list[Turn]:
    """The object from `count` sides, evenly around it, all from one distance."""
    azimuths = [2 * np.pi * i / count for i in range(count)]
    reach = max(reach_around(product, azimuth) for azimuth in azimuths)
    with ThreadPoolExecutor(threads) as pool:
        return list(
            pool.map(lambda azimuth: _turn(product, azimuth, side, reach=reach, zoom=1.0), azimuths)
        )


def render_close_up(product: Product, *, side: int, zoom: float) -> Turn:
    """The middle of the object's front, with a longer lens."""
    return _turn(product, 0.0, side, reach=reach_around(product, 0.0), zoom=zoom)


def render_coverage(product: Product, *, count: int, side: int) -> list[U8]:
    """(side, side, 4) pictures from `count` sides: how certain the shape is, in these colours."""
    azimuths = [2 * np.pi * i / count for i in range(count)]
    reach = max(reach_around(product, azimuth) for azimuth in azimuths)
    pictures = []
    for azimuth in azimuths:
        fine = side * _SUPERSAMPLING
        origin, rays = rays_around(product, azimuth, fine, reach=reach)
        hits = cast(product, origin, rays)
        pictures.append(_picture(_coverage(product, hits, -rays[hits.rays]), hits, fine, side))
    return pictures


def _coverage(product: Product, hits: Hits, toward: F32) -> F32:
    """(N, 3) sRGB, shaded by the geometry."""
    size = len(product.confidence)
    uv = at_hits(product.uv, product.faces, hits.face, hits.weights)
    column, row = np.clip((uv * size).astype(np.int64), 0, size - 1).T
    trust = product.confidence[row, column, None] / np.float32(255)
    color = np.where(trust > 0, LITTLE + (MUCH - LITTLE) * trust, UNSEEN)
    a, b, c = (product.vertices[product.faces[hits.face, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    facing = (normal * toward).sum(1) / np.maximum(np.linalg.norm(normal, axis=1), 1e-20)
    color = np.where(facing[:, None] < 0, INSIDE, color)
    return np.asarray(color * (0.45 + 0.55 * np.abs(facing))[:, None], np.float32)


def _turn(product: Product, azimuth: float, side: int, *, reach: float, zoom: float) -> Turn:
    fine = side * _SUPERSAMPLING
    origin, rays = rays_around(product, azimuth, fine, reach=reach, zoom=zoom)
    hits = cast(product, origin, rays)
    toward = -rays[hits.rays]
    edge = np.linalg.norm(rays[0] - rays[fine - 1]) / fine * hits.distance  # a pixel there, metres
    return Turn(
        _picture(srgb_from_linear(shade(product, hits, toward)), hits, fine, side),
        _picture(_wire(product, hits, toward, edge * _SUPERSAMPLING), hits, fine, side),
    )


def _picture(colors: F32, hits: Hits, fine: int, side: int) -> U8:
    """Colours (N, 3) at the hits, averaged to (side, side, 4)."""
    image = np.zeros((fine * fine, 4), np.float32)
    image[hits.rays, :3] = colors
    image[hits.rays, 3] = 1
    small = np.asarray(
        cv2.resize(image.reshape(fine, fine, 4), (side, side), interpolation=cv2.INTER_AREA)
    )
    small[..., :3] /= np.maximum(small[..., 3:], 1e-6)
    return np.asarray(np.round(np.clip(small, 0, 1) * 255), np.uint8)


def _wire(product: Product, hits: Hits, toward: F32, pixel: F32) -> F32:
    """(N, 3) sRGB of clay with the edges of the triangles drawn on it.

    Args:
        pixel: (N,) size of a picture's pixel at the surface, metres.
    """
    a, b, c = (product.vertices[product.faces[hits.face, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    opposite = np.stack([np.linalg.norm(e, axis=1) for e in (c - b, a - c, b - a)], 1)
    heights = area[:, None] / np.maximum(opposite, 1e-12)
    nearest = (hits.weights * heights).min(1) / pixel  # distance to the next edge, in pixels
    line = np.clip(_LINE_WIDTH + 0.5 - nearest, 0, 1)
    # Triangles of a few pixels would be nothing but lines.
    line *= np.clip(heights.min(1) / pixel / 8, 0.12, 1)
    cosine = np.abs((normal * toward).sum(1)) / np.maximum(area, 1e-20)
    clay = _CLAY * (0.35 + 0.65 * cosine)[:, None]
    return np.asarray(clay + (_LINE - clay) * line[:, None], np.float32)
