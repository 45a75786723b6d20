"""How far each place of a mesh may lie off the true surface.

Three things tell where a surface is: outlines that touch it, fine detail that photos agree on, and
the trained field, where it and the mesh show the same. Where all three are missing, as in a smooth
hollow of a glossy object, the mesh is a guess. The distance to be expected is a log-linear model of
what can be measured. Its numbers were fitted to thirteen captures of the proving ground with known
truth; docs/experiments/confidence.md has how it was found and what it reaches on others.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import MeshError
from refdgs_pipe.geometry import hit_depth, outline_distance, spread_over
from refdgs_pipe.ray_casting import Solid
from refdgs_pipe.texture.points import bilinear

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Rows = tuple[Ints, Ints, Ints]

_LONGEST = 640  # pixels of the photos that are looked at
HALF = 0.7  # percent of the diagonal: an expected distance that halves the confidence
_COUNT = 15_000  # samples of the surface
_AROUND = 16  # samples whose measures count together
_BETWEEN = 3  # samples that a place between them takes its distance from
_SOLID = 0.5  # of a mask
_LEAST_COSINE, _PATCH_COSINE = 0.1, 0.25
_BEHIND = 0.006  # of the diagonal: a place this far behind what a ray meets is hidden
_SIDE, _STEP = 5, 1.2  # places along a patch's side; pixels between them
_SOFT = 0.7  # pixels by which photos are blurred
_NOISE = 1e-4  # of patches, squared sRGB
_TOUCHED = 0.4  # percent of the diagonal: an outline this near touches
_THIRD = 2  # the outline that counts: two more are nearer
_NONE = 99.0  # percent: no outline
_ROUNDING = 0.03  # percent: smaller distances are all alike


@dataclass(frozen=True)
class ShapeErrors:
    """Distances from the true surface that are to be expected.

    Args:
        points: (S, 3) samples of a mesh, world.
        percent: (S,) of the mesh's diagonal.
    """

    points: F64
    percent: F32

    def confidence(self, points: F32) -> F32:
        """(N,) 1 / (1 + (e / HALF)^2) at points (N, 3) of the mesh; e: the distance expected."""
        from scipy.spatial import cKDTree

        apart, rows = cKDTree(self.points).query(points, k=_BETWEEN)
        weights = 1 / np.maximum(apart, 1e-9)
        weights /= weights.sum(1, keepdims=True)
        expected = (weights * self.percent[rows]).sum(1)
        return np.asarray(1 / (1 + (expected / HALF) ** 2), np.float32)


def expected_errors(
    mesh: UvMesh,
    cameras: list[Camera],
    load: Callable[..., Photo],
    draw: Callable[[Camera], SurfaceMap],
    track: Callable[[list[Camera], str], Iterable[Camera]],
) -> ShapeErrors:
    """Measure samples of a mesh in all views, and tell how far they may lie off.

    The measures of a sample are averaged with those of its neighbours. One that no view sees counts
    as the worst.

    Args:
        cameras: of the photos that are looked at; at least one.
        load: gives a camera's photo, `scale` times as large.
        draw: gives what the trained field shows to a camera.
        track: wraps the cameras and says what is done, to report progress.

    Raises:
        CorruptError: a photo or its mask is missing or damaged.
        MeshError: the mesh has no area.
    """
    from scipy.spatial import cKDTree

    witness = _Witness(mesh, [camera.fitted(_LONGEST) for camera in cameras])
    if not len(witness.points):
        raise MeshError("the mesh has no area. Run extract again, or drop the adopted mesh")
    for camera in track(cameras, "comparing shape and photos"):
        photo = load(camera, scale=camera.fitted(_LONGEST).width / camera.width)
        witness.add(photo, draw(photo.camera))
    measures = witness.measures()
    around = cKDTree(witness.points).query(witness.points, k=_AROUND)[1]
    mean = {name: values[around].mean(1) for name, values in measures.items()}
    expected = np.exp(_logarithm(mean, with_outlines=witness.outlined)) - _ROUNDING
    return ShapeErrors(witness.points, np.maximum(expected, 0).astype(np.float32))


def _logarithm(m: dict[str, F64], *, with_outlines: bool) -> F64:
    """The fitted model: (S,) logarithm of the distance in percent of the diagonal, plus _ROUNDING.

    Args:
        m: of `_Witness.measures`.
        with_outlines: whether there were masks; without them, other weights were fitted.
    """
    if not with_outlines:
        seen = -1.52 * m["agreement"] - 1.17 * m["cosine"]
        return -0.43 + seen + 0.27 * m["turned"] + 0.035 * m["missing"]
    outlines = 0.50 * m["outline"] - 0.605 * m["touching"]
    seen = -1.525 * m["agreement"] - 0.58 * m["cosine"]
    return 0.41 + outlines + seen + 0.58 * m["turned"] + 0.405 * m["missing"]


class _Witness:
    """Samples of a mesh, and sums of what views tell of them."""

    def __init__(self, mesh: UvMesh, cameras: Sequence[Camera]) -> None:
        vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
        self._solid = Solid(mesh.vertices, faces)
        face, weights = spread_over(vertices, faces, _COUNT, 0)
        corners = faces[face]
        self.points = np.einsum("nk,nkc->nc", weights, vertices[corners])
        normals = np.einsum("nk,nkc->nc", weights, mesh.normals[corners].astype(np.float64))
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        self._normals = normals / np.maximum(length, 1e-9)
        self._unit = float(np.linalg.norm(np.ptp(vertices[np.unique(faces)], axis=0))) / 100
        count = len(self.points)
        self._cosine, self._weight = np.zeros(count), np.zeros(count)
        self._turned, self._alpha = np.zeros(count), np.zeros(count)
        self._nearest = np.full((count, _THIRD + 1), _NONE)  # outlines, rising
        self._touching = np.zeros(count)
        self.outlined = False
        self._patches = _Patches(self.points, self._normals, _pixel(self.points, cameras))

    def add(self, photo: Photo, maps: SurfaceMap) -> None:
        """Take what one view tells."""
        camera = photo.camera
        pixels, depth = camera.project(self.points)
        toward = camera.center - self.points
        cosine = (toward * self._normals).sum(1) / np.linalg.norm(toward, axis=1)
        size = (camera.width, camera.height)
        inside = np.flatnonzero((depth > 0) & (pixels >= 0).all(1) & (pixels < size).all(1))
        column, row = pixels[inside].astype(np.int64).T
        if photo.mask is not None:
            self._outline(photo.mask, (inside, row, column), depth[inside] / camera.K[0, 0])
        front = hit_depth(self._solid, camera)[row, column]
        slack = 100 * _BEHIND * self._unit / np.maximum(cosine[inside], 0.2)
        seen = (front > 0) & (np.abs(front - depth[inside]) < slack)
        seen &= cosine[inside] > _LEAST_COSINE
        rows, row, column = inside[seen], row[seen], column[seen]
        self._field(maps, (rows, row, column), cosine[rows])
        rows = rows[cosine[rows] > _PATCH_COSINE]
        self._patches.add(photo, rows, cosine[rows])

    def _outline(self, mask: F32, at: Rows, pixel: F64) -> None:
        """How near the mask's outline is, in percent; pixel: world units of one, there."""
        rows, row, column = at
        away = np.abs(outline_distance(mask >= _SOLID)[row, column]) * pixel / self._unit
        self._touching[rows] += away < _TOUCHED
        joined = np.concatenate([self._nearest[rows], away[:, None]], axis=1)
        self._nearest[rows] = np.sort(joined, axis=1)[:, :-1]
        self.outlined = True

    def _field(self, maps: SurfaceMap, at: Rows, cosine: F64) -> None:
        """How much of the field is there, and how its surface is turned, in degrees."""
        rows, row, column = at
        alpha = maps.alpha[row, column].astype(np.float64)
        weight = cosine**2 * alpha
        normal = maps.normal[row, column]
        alike = np.clip((normal * self._normals[rows]).sum(1), -1, 1)
        self._weight[rows] += weight
        self._alpha[rows] += weight * alpha
        self._turned[rows] += weight * np.degrees(np.arccos(alike))
        self._cosine[rows] = np.maximum(self._cosine[rows], cosine)

    def measures(self) -> dict[str, F64]:
        """What the model weighs, (S,) each.

        outline: logarithm of the distance to the third nearest outline, percent of the diagonal;
        touching: of the number of outlines that touch; agreement: of fine detail, 0 to 1; cosine:
        of the best view; turned: logarithm of the angle between the normals of field and mesh,
        degrees; missing: of what the field lacks of full opacity.
        """
        weight = np.maximum(self._weight, 1e-9)
        return {
            "outline": np.log(self._nearest[:, _THIRD] + 0.3),
            "touching": np.log(self._touching + 1),
            "agreement": self._patches.agreement(),
            "cosine": self._cosine,
            "turned": np.log(self._turned / weight + 2),
            "missing": np.log(np.maximum(1 - self._alpha / weight, 0) + 0.01),
        }


class _Patches:
    """Small patches of a surface, and the grey values that views show there.

    Args:
        pixel: (S,) world units of one pixel, there.
    """

    def __init__(self, points: F64, normals: F64, pixel: F64) -> None:
        side = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
        u = np.cross(normals, side)
        u /= np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-9)
        steps = _STEP * (np.arange(_SIDE) - _SIDE // 2)
        a, b = (grid.reshape(-1, 1) for grid in np.meshgrid(steps, steps, indexing="ij"))
        offsets = a * u[:, None] + b * np.cross(normals, u)[:, None]
        self._places = points[:, None] + pixel[:, None, None] * offsets  # (S, 25, 3)
        self._sum = np.zeros(self._places.shape[:2])
        self._squares = np.zeros(self._places.shape[:2])
        self._weight = np.zeros(len(points))

    def add(self, photo: Photo, rows: Ints, cosine: F64) -> None:
        """Take what a photo shows of some of them."""
        if not len(rows):
            return
        grey = cv2.cvtColor(photo.rgb, cv2.COLOR_RGB2GRAY)
        grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), _SOFT), np.float32)
        uv = photo.camera.project(self._places[rows].reshape(-1, 3))[0].astype(np.float32)
        values = bilinear(grey[..., None], uv).reshape(len(rows), -1).astype(np.float64)
        values -= values.mean(1, keepdims=True)
        weight = cosine[:, None] ** 2
        self._sum[rows] += weight * values
        self._squares[rows] += weight * values**2
        self._weight[rows] += weight[:, 0]

    def agreement(self) -> F64:
        """(S,) share of the patches' contrast that all views have in common, 0 to 1."""
        weight = np.maximum(self._weight, 1e-6)[:, None]
        mean = self._sum / weight
        common = (mean**2).mean(1)
        apart = np.maximum(self._squares / weight - mean**2, 0).mean(1)
        return np.asarray(common / (common + apart + _NOISE))


def _pixel(points: F64, cameras: Sequence[Camera]) -> F64:
    """(S,) world units of a pixel at points (S, 3), in the median over the cameras before them."""
    depths = np.stack([camera.project(points)[1] / camera.K[0, 0] for camera in cameras], axis=1)
    before = np.where(depths > 0, depths, np.nan)
    before[np.isnan(before).all(1)] = 0
    return np.asarray(np.nanmedian(before, axis=1))
