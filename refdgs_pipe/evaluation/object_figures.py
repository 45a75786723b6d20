"""The figures of the object: a result held against its photos, and against itself, on the object.

No ground truth is looked at. Where masks say what the object is, they are believed; without masks
the object is what the field and the mesh show of it.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.object_figures import ObjectFigures
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.evaluation.wholeness import (
    hanging_share,
    height_above,
    loose_parts,
    open_holes,
    seen_shares,
)
from refdgs_pipe.geometry import hit_depth
from refdgs_pipe.irradiance import links_of
from refdgs_pipe.metrics import psnr
from refdgs_pipe.mirrored import Glimpse, unexplained
from refdgs_pipe.ray_casting import Solid

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

TRAINING_VIEWS = 4  # photos of the training that are compared too
_SOLID = 0.5  # alpha from which on a pixel counts as covered
_MARGIN = 0.01  # of the longer side: how far round the object its pixels reach
_WORST = 5.0  # percent of the diagonal: larger differences of depth count as this
_BEFORE = 0.01  # of the diagonal: nearer by this than what another view sees is a contradiction
_PAIRED = 8  # views that are held against each other
_POINTS = 2000  # of each of them
_SEEN = 0.02  # of the ball's diameter: depth by which a place that is seen may lie off


@dataclass(frozen=True)
class _Glance:
    """What one view tells; None: nothing."""

    psnr: float | None
    asset_psnr: float | None
    outline: float | None
    depth: float | None


class Witness:
    """Collects evidence about one mesh, view by view."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._solid = Solid(mesh.vertices, mesh.faces)
        used = mesh.vertices[np.unique(mesh.faces)].astype(np.float64)
        self._diagonal = float(np.linalg.norm(np.ptp(used, axis=0))) if len(used) else 1.0
        self._mesh = mesh
        self._glances: list[_Glance] = []
        self._trained: list[_Glance] = []
        self._maps: list[SurfaceMap] = []

    def look(
        self,
        photo: Photo,
        picture: F32,
        maps: SurfaceMap,
        asset: F32 | None = None,
        *,
        trained: bool = False,
    ) -> tuple[float | None, float | None]:
        """Compare one view.

        Args:
            picture: (H, W, 3) sRGB in [0, 1] that the field shows, over white where there is a
                mask; asset: the same of the textured mesh.
            trained: the photo was trained with.

        Returns:
            dB of both over the object's pixels; None where nothing was compared.
        """
        there = hit_depth(self._solid, photo.camera)
        claimed = maps.alpha >= _SOLID
        wanted = claimed if photo.mask is None else photo.mask >= _SOLID
        pixels = object_pixels(wanted, claimed, there > 0) & photo.valid
        target = over_white(photo)
        glance = _Glance(
            _db(picture, target, pixels),
            None if asset is None else _db(asset, target, pixels),
            outline_apart(there > 0, wanted, photo.valid),
            self._depth_apart(there, maps),
        )
        (self._trained if trained else self._glances).append(glance)
        self._maps.append(maps)
        return glance.psnr, glance.asset_psnr

    def evidence(
        self,
        views: Views,
        model: SparseModel,
        textured: TexturedMesh | None,
        *,
        held_out: bool,
        photos: Iterable[Photo] = (),
        ground: F64 | None = None,
        stands: bool = False,
        lowest: float | None = None,
    ) -> ObjectFigures:
        """What all views tell together, and what the mesh tells without any.

        Args:
            photos: small ones, to hold colours and reflections against each other.
            ground: (3,) unit normal of the ground through the world's origin, if it is known.
            stands: whether the whole object has to reach it.
            lowest: as `ObjectFigures` has it.
        """
        holes, hole_length = open_holes(self._mesh, model.up)
        parts, part_share = loose_parts(self._mesh)
        floats = hanging = None
        if stands and ground is not None:
            floats, hanging = height_above(self._mesh, ground), hanging_share(self._mesh, ground)
        seen, unseen = (None, None) if textured is None else seen_shares(textured)
        return ObjectFigures(
            photos=len(model.cameras) + len(model.lost),
            placed=len(model.cameras),
            masked=views.background != "photo",
            held_out=held_out,
            psnr=_mean([glance.psnr for glance in self._glances]),
            training_psnr=_mean([glance.psnr for glance in self._trained]),
            asset_psnr=_mean([glance.asset_psnr for glance in self._glances]),
            outline=_mean([glance.outline for glance in self._glances]),
            depth=_mean([glance.depth for glance in self._glances]),
            contradicted=contradicted(self._maps, _BEFORE * self._diagonal),
            unexplained=self._unexplained(photos, ground, model.ball.radius),
            seen=seen,
            unseen=unseen,
            holes=holes,
            hole_length=hole_length / self._diagonal,
            parts=parts,
            part_share=part_share,
            floats=floats,
            hanging=hanging,
            lowest=lowest,
            metres=model.metres_per_unit is not None,
        )

    def _unexplained(
        self, photos: Iterable[Photo], ground: F64 | None, radius: float
    ) -> float | None:
        """Share of the surface where photos agree neither on a colour nor on a reflection."""
        glimpses = (
            Glimpse(photo.camera, photo.rgb, hit_depth(self._solid, photo.camera))
            for photo in photos
        )
        vertices, faces = self._mesh.vertices.astype(np.float64), self._mesh.faces
        corners = vertices[faces]
        sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        thirds = np.repeat(np.linalg.norm(sides, axis=1) / 6, 3)
        return unexplained(
            vertices,
            self._mesh.vertex_normals().astype(np.float64),
            np.asarray(np.bincount(faces.ravel(), thirds, len(vertices)), np.float64),
            links_of(faces),
            glimpses,
            near=_SEEN * 2 * radius,
            ground=ground,
            radius=radius,
        )

    def _depth_apart(self, there: F32, maps: SurfaceMap) -> float | None:
        """Percent of the diagonal, mean over the pixels where mesh and field are."""
        both = (there > 0) & (maps.depth > 0) & (maps.alpha >= _SOLID)
        if not both.any():
            return None
        apart = 100 * np.abs(there - maps.depth)[both] / self._diagonal
        return float(np.minimum(apart, _WORST).mean())


def over_white(photo: Photo) -> F32:
    """(H, W, 3) the photo, laid over white by its mask if it has one."""
    if photo.mask is None:
        return photo.rgb
    m = photo.mask[..., None]
    return np.asarray(photo.rgb * m + (1 - m), np.float32)


def object_pixels(*covered: Mask) -> Mask:
    """(H, W) what any of the masks covers, and a narrow margin round it."""
    there = np.logical_or.reduce(covered)
    reach = 2 * max(1, round(_MARGIN * max(there.shape))) + 1
    wide = cv2.dilate(there.astype(np.uint8), np.ones((reach, reach), np.uint8))
    return np.asarray(wide > 0)


def outline_apart(result: Mask, wanted: Mask, valid: Mask) -> float | None:
    """How far two outlines lie apart: mean width of what one covers alone, in percent of the size.

    The size is the square root of the wanted area. None where nothing is wanted.
    """
    wanted = wanted & valid
    size = float(np.sqrt(wanted.sum()))
    if not size:
        return None
    inner = cv2.erode(np.pad(wanted.astype(np.uint8), 1), np.ones((3, 3), np.uint8), borderValue=0)[
        1:-1, 1:-1
    ]
    length = max(int((wanted & (inner == 0)).sum()), 1)
    return float(100 * ((result & valid) ^ wanted).sum() / length / size)


def contradicted(maps: Sequence[SurfaceMap], slack: float) -> float | None:
    """Share of the places that one view sees which stand in the way of another view.

    There the other view sees something further behind, or nothing at all. None without two views.

    Args:
        slack: world units that may lie between.
    """
    chosen = [maps[i] for i in np.unique(np.linspace(0, len(maps) - 1, _PAIRED).astype(int))]
    nearest = [_nearest(view, slack) for view in chosen]
    shares = []
    for a in chosen:
        covered = np.flatnonzero((a.alpha >= _SOLID) & (a.depth > 0))
        covered = covered[:: max(1, len(covered) // _POINTS)]
        inside = a.camera.pixel_rays().reshape(-1, 3)[covered] * a.depth.reshape(-1, 1)[covered]
        pose = a.camera.world_from_cam
        points = inside @ pose[:3, :3].T + pose[:3, 3]
        for b, before in zip(chosen, nearest, strict=True):
            if b is not a and len(points):
                shares.append(_in_the_way(points, before, b.camera))
    known = [share for share in shares if share is not None]
    return float(np.mean(known)) if known else None


def _in_the_way(points: NDArray[np.float64], nearest: F32, camera: Camera) -> float | None:
    """Share of points (N, 3) that a view sees past; None where all are out of its picture."""
    uv, depth = camera.project(points)
    inside = (depth > 0) & (uv >= 0).all(1) & (uv < (camera.width, camera.height)).all(1)
    if not inside.any():
        return None
    column, row = uv[inside].astype(np.int64).T
    return float((depth[inside] < nearest[row, column]).mean())


def _nearest(view: SurfaceMap, slack: float) -> F32:
    """(H, W) depth before which nothing is seen in 3 x 3 pixels: outlines are known to one."""
    there = (view.alpha >= _SOLID) & (view.depth > 0)
    depth = np.where(there, view.depth - np.float32(slack), np.float32(1e30))
    return np.asarray(cv2.erode(depth, np.ones((3, 3), np.uint8)), np.float32)


def _db(image: F32, target: F32, pixels: Mask) -> float | None:
    return psnr(image[pixels], target[pixels]) if pixels.any() else None


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
