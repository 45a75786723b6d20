"""The field as a camera sees it, in 8 bits, by the project's own renderer, on the CPU."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import srgb_from_linear

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

KINDS = ("photo", "diffuse", "specular", "normal", "roughness", "coverage", "depth")
_BACKDROP = np.float32(1.0)  # white
_NEAREST = 0.02  # of the distance to the ball's centre: nothing is drawn before that


@dataclass(frozen=True)
class Drawn:
    """A picture of the field.

    Args:
        pixels: (h, w, 3) sRGB over white.
        depth: (h, w) camera z in world units; infinite where nothing is.
    """

    pixels: U8
    depth: F32


def camera_at(
    position: F64, wxyz: F64, *, fov: float, width: int, height: int, name: str = "view"
) -> Camera:
    """A camera in OpenCV's frame from where a viewer stands.

    Args:
        position: (3,) world; wxyz: (4,) unit, world from camera.
        fov: vertical, radians.
    """
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(wxyz, scalar_first=True).as_matrix().T
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(position, float)
    focal = height / 2 / np.tan(fov / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Camera(name, width, height, K, pose)


def size_for(aspect: float, longest: int) -> tuple[int, int]:
    """Width and height of a picture with that ratio of width to height."""
    aspect = float(np.clip(aspect if np.isfinite(aspect) else 1.0, 0.2, 5.0))
    if aspect >= 1:
        return longest, max(1, round(longest / aspect))
    return max(1, round(longest * aspect)), longest


def drawn(field: SurfelField, camera: Camera, kind: str) -> Drawn:
    """What a camera sees of the field.

    Args:
        kind: one of KINDS. "photo" is the picture as the photos have it; "specular" is reflections,
            "coverage" how opaque the object is.
    """
    from refdgs_pipe.training.render import render_surface_map

    maps = render_surface_map(field, camera, threads=1)
    alpha = maps.alpha[..., None]
    if kind == "photo":
        shown = np.clip(maps.color + (1 - alpha) * _BACKDROP, 0, 1)
    else:
        shown = alpha * _colored(maps, kind) + (1 - alpha) * _BACKDROP
    pixels = np.round(np.clip(np.nan_to_num(shown), 0, 1) * 255).astype(np.uint8)
    depth = np.where(maps.alpha > 0.5, maps.depth, np.inf).astype(np.float32)
    return Drawn(pixels, depth)


def _colored(maps: SurfaceMap, kind: str) -> F32:
    """(H, W, 3) a map in [0, 1], as it is shown."""
    if kind in ("diffuse", "specular"):
        linear = maps.diffuse if kind == "diffuse" else maps.specular
        return srgb_from_linear(np.clip(linear, 0, 1))
    if kind == "normal":
        return np.asarray(maps.normal * 0.5 + 0.5, np.float32)
    if kind == "roughness":
        return _gray(maps.roughness)
    if kind == "coverage":
        return _gray(1 - maps.alpha)
    there = maps.depth > 0
    if not there.any():
        return _gray(np.ones_like(maps.depth))
    near, far = np.quantile(maps.depth[there], [0.01, 0.99])
    return _gray(np.clip((maps.depth - near) / max(float(far - near), 1e-9), 0, 1) * 0.85)


def _gray(values: F32) -> F32:
    return np.repeat(np.asarray(values, np.float32)[..., None], 3, axis=-1)
