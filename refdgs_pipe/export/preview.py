"""A picture of the product from three sides, in a simple studio: what it will look like in use."""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.color import linear_from_srgb, srgb_from_linear
from refdgs_pipe.export.product import Product
from refdgs_pipe.light import reflected_share
from refdgs_pipe.ray_casting import Hits, Solid

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

_AZIMUTHS_DEG = (30.0, 150.0, 270.0)
_ELEVATION_DEG = 22.0
_FIELD_OF_VIEW_DEG = 30.0
_SUPERSAMPLING = 2
_MARGIN = 1.06
_BACKDROP = 0.72  # sRGB
# Soft boxes: direction (+Y up), radiance, size (smaller is sharper).
_BOXES = (
    ((0.5, 0.75, 0.45), 3.0, 0.04),
    ((-0.8, 0.45, 0.4), 1.6, 0.03),
    ((0.1, 0.3, -0.95), 1.4, 0.05),
)


def render_preview(product: Product, *, side: int = 480) -> U8:
    """(side, 3 * side, 3) sRGB picture: three views, evenly around the object."""
    import cv2

    views = [_view(product, np.deg2rad(a), side * _SUPERSAMPLING) for a in _AZIMUTHS_DEG]
    linear = cv2.resize(
        np.concatenate(views, 1), (side * len(views), side), interpolation=cv2.INTER_AREA
    )
    return np.round(srgb_from_linear(np.asarray(linear, np.float32)) * 255).astype(np.uint8)


def _view(product: Product, azimuth: float, side: int) -> F32:
    """(side, side, 3) linear picture of one view."""
    origin, rays = rays_around(product, azimuth, side)
    hits = cast(product, origin, rays)
    backdrop = linear_from_srgb(np.full((side * side, 3), _BACKDROP, np.float32))
    backdrop[hits.rays] = shade(product, hits, -rays[hits.rays])
    return backdrop.reshape(side, side, 3)


def cast(product: Product, origin: F32, rays: F32) -> Hits:
    """What unit rays (N, 3) from one point meet first."""
    return Solid(product.vertices, product.faces).first(origin, rays)


def reach_around(product: Product, azimuth: float) -> float:
    """How far from the middle of the box a camera sees the whole object, metres."""
    away, right, above = _axes(azimuth)
    aside, height, depth = (
        (product.vertices - _middle(product)) @ np.stack([right, above, away], 1)
    ).T
    # From this far, the widest vertex just touches the picture's margin.
    half = np.tan(np.deg2rad(_FIELD_OF_VIEW_DEG) / 2)
    reach = depth + np.maximum(np.abs(aside), np.abs(height)) / half * _MARGIN
    return float(reach.max())


def rays_around(
    product: Product, azimuth: float, side: int, *, reach: float | None = None, zoom: float = 1.0
) -> tuple[F32, F32]:
    """The eye (3,) and unit rays (side * side, 3) of a camera that looks at the object's middle.

    Args:
        azimuth: radians, from the front (+Z) towards +X.
        reach: the eye's distance from the middle, metres; None: as near as shows all of it.
        zoom: how much longer the lens is than one that shows all of it.
    """
    away, right, above = _axes(azimuth)
    middle = _middle(product)
    eye = middle + away * (reach_around(product, azimuth) if reach is None else reach)
    half = np.tan(np.deg2rad(_FIELD_OF_VIEW_DEG) / 2) / zoom
    steps = ((np.arange(side) + 0.5) / side * 2 - 1) * half
    rays = steps[None, :, None] * right - steps[:, None, None] * above - away
    rays = rays.reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return eye.astype(np.float32), rays.astype(np.float32)


def _axes(azimuth: float) -> tuple[F64, F64, F64]:
    """Unit vectors from the object to the camera, to the picture's right and to its top."""
    up = np.deg2rad(_ELEVATION_DEG)
    away = np.array([np.sin(azimuth) * np.cos(up), np.sin(up), np.cos(azimuth) * np.cos(up)])
    right = np.cross([0.0, 1.0, 0.0], away)
    right /= np.linalg.norm(right)
    return away, right, np.cross(away, right)


def _middle(product: Product) -> F64:
    """(3,) of the object's box."""
    return np.asarray((product.vertices.min(0) + product.vertices.max(0)) / 2, np.float64)


def shade(product: Product, hits: Hits, toward: F32) -> F32:
    """(N, 3) linear radiance: diffuse under a soft sky, reflections by the split sum.

    Args:
        toward: (N, 3) unit, from the surface to the eye.
    """
    corners = product.faces[hits.face]

    def at(values: F32) -> F32:
        return np.asarray(np.einsum("nk,nkc->nc", hits.weights, values[corners]), np.float32)

    uv = at(product.uv)
    base = linear_from_srgb(_sample(product.base_color, uv))
    rough = np.maximum(_sample(product.roughness[..., None], uv), 0.04)
    metal = _sample(product.metallic[..., None], uv)
    local = _sample(product.normal, uv) * 2 - 1
    tangent, plain = at(product.tangents[:, :3]), at(product.normals)
    across = np.cross(plain, tangent) * product.tangents[corners[:, 0], 3:]
    normal = local[:, :1] * tangent + local[:, 1:2] * across + local[:, 2:] * plain
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
    cosine = np.clip((normal * toward).sum(1, keepdims=True), 0.02, 1)
    mirrored = 2 * (normal * toward).sum(1, keepdims=True) * normal - toward
    f0 = 0.04 * (1 - metal) + base * metal
    diffuse = base * (1 - metal) * _light(normal, np.ones_like(rough))
    return np.asarray(
        diffuse + _light(mirrored, rough) * reflected_share(f0, rough, cosine), np.float32
    )


def _light(directions: F32, rough: F32) -> F32:
    """(N, 1) radiance of the studio, blurred as a surface of that roughness sees it."""
    blur = rough**2
    height = directions[:, 1:2]
    edge = 0.15 + 0.85 * blur  # the floor's horizon, sharp in a mirror
    sky = np.clip(height / edge * 0.5 + 0.5, 0, 1)
    total = 0.2 + (0.5 + 0.1 * height) * sky
    for direction, radiance, size in _BOXES:
        toward = np.array(direction) / np.linalg.norm(direction)
        wide = size + 0.5 * blur
        lobe = np.exp(((directions @ toward)[:, None] - 1) / wide)
        total = total + radiance * size / wide * lobe
    return np.asarray(total, np.float32)


def _sample(picture: U8, uv: F32) -> F32:
    """(N, C) bilinear samples in [0, 1]."""
    size = len(picture)
    x, y = np.clip(uv * size - 0.5, 0, size - 1.001).T
    left, top = x.astype(int), y.astype(int)
    right, bottom = np.minimum(left + 1, size - 1), np.minimum(top + 1, size - 1)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    upper = picture[top, left] * (1 - fx) + picture[top, right] * fx
    lower = picture[bottom, left] * (1 - fx) + picture[bottom, right] * fx
    return np.asarray((upper * (1 - fy) + lower * fy) / 255, np.float32)
