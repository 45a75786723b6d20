"""How far a mesh lies off the surface, told by how its views disagree on the colours there.

Where the mesh lies too deep, an eye that looks aslant finds the colour of a place beside it, and
eyes from other sides find others. The displacement along the normal at which they agree is found
by least squares from the colours' gradients (Lucas and Kanade 1981), for each vertex on its own.
"""

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.geometry import without_jumps
from refdgs_pipe.ray_casting import Solid
from refdgs_pipe.surface.silhouettes import looked_up

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_NOISE = 0.02  # of a view's colour, sRGB-encoded
_DOUBT = 4.0  # more noise where the views disagree whatever the displacement
_MATTE = 4  # power of the matte share of a place: little is told by what also mirrors
_LEAST_COSINE = 0.25
_MIN_ALPHA = 0.9


class Pattern:
    """The colours that one view sees on the surface, without reflections, to be looked up."""

    def __init__(self, view: SurfaceMap, *, near: float) -> None:
        """Keep what is matte.

        Args:
            near: depths further apart than this are another part's, world units.
        """
        self.camera: Camera = view.camera
        self.color = srgb_from_linear(np.clip(view.diffuse, 0, 1)).astype(np.float16)
        matte, shine = (np.abs(v).mean(-1) for v in (view.diffuse, view.specular))
        whole = without_jumps(view.depth, view.normal, view.camera, near)
        trust = (matte / np.maximum(matte + shine, 1e-4)) ** _MATTE
        self.trust = np.where(whole & (view.alpha >= _MIN_ALPHA), trust, 0).astype(np.float16)

    def at(self, pixels: F64, blur: float) -> tuple[F32, F32, F32, F32]:
        """Colours (N, 3), their gradients to the right and downwards (N, 3), and trust (N,).

        Args:
            blur: of the picture, in pixels; closer to its ends and jumps nothing is trusted.
        """
        color = cv2.GaussianBlur(self.color.astype(np.float32), (0, 0), blur)
        across, down = (
            cv2.Sobel(color, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1))
        )
        reach = 2 * int(np.ceil(3 * blur)) + 3
        trust = cv2.erode(self.trust.astype(np.float32), np.ones((reach, reach), np.uint8))
        found = [looked_up(np.asarray(p, np.float32), pixels) for p in (color, across, down, trust)]
        return found[0], found[1], found[2], found[3][:, 0]


def disagreement(
    mesh: TriangleMesh,
    normals: F32,
    solid: Solid,
    patterns: Iterable[Pattern],
    *,
    near: float,
    blur: float,
) -> tuple[F64, F64]:
    """How much each vertex (V,) is told, and how far it should move outwards times that.

    Told is counted in views that see the place on their outline to a pixel.

    Args:
        near: a vertex is seen if nothing is further in front of it, world units.
        blur: of the views, in pixels.
    """
    count = len(mesh.vertices)
    sums = {name: np.zeros(count) for name in ("w", "ii", "ig", "gg", "pixel")}
    first, slope = np.zeros((count, 3)), np.zeros((count, 3))
    for pattern in patterns:
        rows, pixels, moving, cosine, pixel = _seen(mesh, normals, solid, pattern.camera, near)
        color, across, down, trust = pattern.at(pixels, blur)
        gradient = across * moving[:, :1] + down * moving[:, 1:]
        weight = cosine**2 * trust
        sums["w"][rows] += weight
        sums["pixel"][rows] += weight * pixel
        sums["ii"][rows] += weight * (color * color).sum(1)
        sums["ig"][rows] += weight * (color * gradient).sum(1)
        sums["gg"][rows] += weight * (gradient * gradient).sum(1)
        first[rows] += weight[:, None] * color
        slope[rows] += weight[:, None] * gradient
    known = np.maximum(sums["w"], 1e-6)
    bent = np.maximum(sums["gg"] - (slope * slope).sum(1) / known, 0)
    apart = sums["ig"] - (first * slope).sum(1) / known
    moved = -apart / np.maximum(bent, 1e-9)
    left = np.maximum(sums["ii"] - (first * first).sum(1) / known + apart * moved, 0) / known
    scale = (sums["pixel"] / known) ** 2 / (_NOISE**2 + _DOUBT * left)
    return bent * scale, -apart * scale


def _seen(
    mesh: TriangleMesh, normals: F32, solid: Solid, camera: Camera, near: float
) -> tuple[Ints, F64, F64, F64, F64]:
    """The vertices that a camera sees: rows, pixels, what these move by, cosines, pixels' size."""
    points = mesh.vertices.astype(np.float64)
    pixels, depth = camera.project(points)
    toward = camera.center - points
    distance = np.maximum(np.linalg.norm(toward, axis=1), 1e-9)
    cosine = (toward * normals).sum(1) / distance
    size = np.array([camera.width, camera.height])
    there = (depth > 0) & (pixels >= 2).all(1) & (pixels <= size - 2).all(1)
    rows = np.flatnonzero(there & (cosine > _LEAST_COSINE))
    hits = solid.first(camera.center.astype(np.float32), -toward[rows].astype(np.float32))
    free = np.ones(len(rows), bool)
    free[hits.rays] = (1 - hits.distance) * distance[rows[hits.rays]] < near
    rows = rows[free]
    moved, _ = camera.project(points[rows] + 1e-3 * distance[rows, None] * normals[rows])
    moving = (moved - pixels[rows]) / (1e-3 * distance[rows, None])
    return rows, pixels[rows], moving, cosine[rows], depth[rows] / float(camera.K[0, 0])
