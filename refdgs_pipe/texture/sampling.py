"""Pixels of many views, put on the mesh: what each shows, and what its mirrored ray meets."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.photos import Photo, load_photo
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.errors import MeshError
from refdgs_pipe.ground_light import GroundLight, at_roughness
from refdgs_pipe.irradiance import links_of, spread
from refdgs_pipe.ray_casting import Hits, Solid, at_hits
from refdgs_pipe.texture.points import MOVED
from refdgs_pipe.vectors import unit

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
_MIN_ALPHA = 0.9
_MIN_COSINE = 0.1
_DARK, _BRIGHT, _ENOUGH = 0.05, 0.9, 100  # linear; values that tell a photo's exposure
_CALMING = 2  # passes over the normals before their turning is measured
_AROUND = 2  # edges from a place, over which samples are counted


@dataclass(frozen=True)
class Samples:
    """N places on a mesh, each as one view sees it.

    Args:
        face: (N,) of the mesh; weights: (N, 3) of its corners.
        cosine: (N,) between the normal and the way to the eye.
        mirrored: (N, 3) unit, where the mirrored ray goes, where far light stands still.
        near_face: (N,) the face that it meets, -1 for none; near_weights: (N, 3).
        diffuse, specular: (N, 3) linear radiance, as the field splits it.
        photo: (N, 3) linear radiance in the photo, clipped at white; the field's where no photo
            tells.
        roughness: (N,) as the field has it.
        footprint: (N,) the square of the GGX alpha that the normals within a pixel of the photo
            make up, see `seen_roughness`.
        view: (N,) the number of the view.
        glint: (N, 4) of a lamp on the camera: cosines between normal and half vector, normal and
            lamp, lamp and half vector, and the squared inverse distance; None without one. Then
            `specular` is without the lamp's highlight and `photo` is the field's, with it.
        ground: (N, K, 4) `GroundLight.levels` of the mirrored rays, 0 for those that meet the mesh;
            None where the ground's light is not known.
    """

    face: Ints
    weights: F32
    cosine: F32
    mirrored: F32
    near_face: Ints
    near_weights: F32
    diffuse: F32
    specular: F32
    photo: F32
    roughness: F32
    footprint: F32
    view: Ints
    glint: F32 | None = None
    ground: F32 | None = None

    def of_ground(self, roughness: F32) -> F32:
        """(N, 4) as `GroundLight.mirrored`, for a roughness (N,); 0 where nothing is known."""
        if self.ground is None:
            return np.zeros((len(self.face), 4), np.float32)
        return at_roughness(self.ground, roughness)

    @property
    def radiance(self) -> F32:
        """(N, 3) what the eye gets, linear."""
        return self.diffuse + self.specular


@dataclass(frozen=True)
class Shone:
    """A view under a lamp on the camera.

    Args:
        place: (3,) of the lamp, world.
        radiance: (H, W, 3) linear, what the view shows with the lamp's highlights.
    """

    place: F32
    radiance: F32


class Sampler:
    """Takes some pixels of one view after another.

    Args:
        tolerance: how far mesh and map may lie apart, world units. Where a part of the mesh was
            moved, as a bulge that was made flat, they may lie `MOVED` times as far apart. The
            mesh's own normals count there.
        per_view: the most pixels of a view.
        ground: the light below the object, if it is known.
    """

    def __init__(
        self,
        mesh: TriangleMesh,
        *,
        tolerance: float,
        per_view: int,
        ground: GroundLight | None = None,
    ) -> None:
        self.mesh, self.tolerance, self.per_view = mesh, tolerance, per_view
        self.ground = ground
        self._normals = mesh.vertex_normals()
        self._bent = _squared_curvature(mesh, self._normals)
        self._solid = Solid(mesh.vertices, mesh.faces)
        self._parts: list[Samples] = []
        self._near: list[Bools] = []  # of each part's samples: within the tolerance

    def photo_of(self, views: Views, model: SparseModel, camera: Camera) -> Photo:
        """The part of a camera's photo that can show the ball, with enough pixels to take."""
        ball = (model.ball.center, model.ball.radius)
        part = camera.framed(*ball)
        longest = max(256, int(3 * float(np.sqrt(self.per_view))))
        scale = min(1.0, longest / max(part.width, part.height))
        return load_photo(views, model, camera, scale=scale).framed(*ball)

    def look(
        self,
        drawn: Callable[..., SurfaceMap],
        photo: Photo,
        camera: Camera,
        lighting: Lighting,
    ) -> int:
        """Take what a photo and the field show from one camera; gives how many pixels were taken.

        Args:
            drawn: the field from a camera; `lamp=True` with the highlights of a lamp.
            photo: of the camera, at the size to be looked at.
            lighting: how the light moves.
        """
        turn, lamp = lighting.light_from_world(camera.center), None
        if (place := lighting.lamp_of(camera)) is not None:
            lamp = Shone(place, linear_from_srgb(drawn(photo.camera, lamp=True).color))
        focal = float(camera.K[0, 0])
        view = drawn(photo.camera)
        return self.add(view, photo=photo.alone(), focal=focal, turn=turn, lamp=lamp)

    def add(
        self,
        view: SurfaceMap,
        *,
        photo: F32 | None = None,
        focal: float | None = None,
        turn: F64 | None = None,
        lamp: Shone | None = None,
    ) -> int:
        """Take what one view shows; gives how many of its pixels were taken.

        Args:
            photo: (H, W, 3) sRGB of the view's size, NaN where it does not show the object alone.
            focal: of the photo that the field learnt this from, pixels; None: as the view's.
            turn: (3, 3) rotation to where far light stands still; None: in the world.
            lamp: on the camera; None without one.
        """
        camera, mesh = view.camera, self.mesh
        if (seen := self._seen(view)) is None:
            return 0
        rows, hits, near, normal, toward = seen
        face, weights = hits.face, hits.weights
        cosine = (normal * toward).sum(1)
        mirrored = 2 * cosine[:, None] * normal - toward
        pixel = hits.distance / np.float32(focal or camera.K[0, 0])
        bent = at_hits(self._bent, mesh.faces, face, weights)[:, 0] * pixel**2 / 6
        diffuse, specular = (of.reshape(-1, 3)[rows] for of in (view.diffuse, view.specular))
        points = at_hits(mesh.vertices, mesh.faces, face, weights)
        glint = None if lamp is None else _glint(lamp.place - points, normal, toward)
        near_face, near_weights = self._mirror(face, weights, mirrored.astype(np.float32))
        self._near.append(near)
        self._parts.append(
            Samples(
                face,
                weights,
                cosine.astype(np.float32),
                (mirrored if turn is None else mirrored @ turn.T).astype(np.float32),
                near_face,
                near_weights,
                diffuse,
                specular,
                np.clip(_shown(diffuse + specular, rows, photo, lamp), 0, 1).astype(np.float32),
                view.roughness.reshape(-1)[rows],
                bent.astype(np.float32),
                np.full(len(rows), len(self._parts)),
                glint,
                self._below(points, mirrored, near_face),
            )
        )
        return len(rows)

    def _seen(self, view: SurfaceMap) -> tuple[Ints, Hits, Bools, F32, F32] | None:
        """What a view shows of the mesh, at most `per_view` of its pixels; None if nothing.

        Returns:
            The pixels' rows (N,), rising; what they show; whether it is near; normals (N, 3) and
            the ways to the eye (N, 3), unit.
        """
        camera = view.camera
        solid = np.flatnonzero((view.alpha.reshape(-1) >= _MIN_ALPHA) & (view.depth.ravel() > 0))
        chance = np.random.default_rng(len(self._parts))
        if not len(pixels := chance.permutation(solid)[: 2 * self.per_view]):
            return None
        rays = camera.pixel_rays().reshape(-1, 3)[pixels] @ camera.cam_from_world[:3, :3]
        hits = self._solid.first(camera.center.astype(np.float32), rays.astype(np.float32))
        rows = pixels[hits.rays]
        gap = np.abs(hits.distance - view.depth.reshape(-1)[rows])
        near = gap < self.tolerance
        toward = -unit(rays[hits.rays])
        own = at_hits(self._normals, self.mesh.faces, hits.face, hits.weights)
        normal = np.where(near[:, None], view.normal.reshape(-1, 3)[rows], unit(own))
        wanted = (gap < MOVED * self.tolerance) & ((normal * toward).sum(1) > _MIN_COSINE)
        good = np.flatnonzero(wanted)[: self.per_view]
        if not len(good):
            return None
        good = good[rows[good].argsort()]
        return rows[good], hits.chosen(good), near[good], normal[good], toward[good]

    def _below(self, points: F32, mirrored: F32, near_face: Ints) -> F32 | None:
        """`Samples.ground` of places (N, 3) and mirrored rays (N, 3) in the world."""
        if self.ground is None:
            return None
        met = self.ground.levels(points, mirrored)
        met[near_face >= 0] = 0
        return met

    def _mirror(self, face: Ints, weights: F32, mirrored: F32) -> tuple[Ints, F32]:
        """What the mirrored rays meet: faces, -1 for none, and weights of their corners."""
        mesh = self.mesh
        points = at_hits(mesh.vertices, mesh.faces, face, weights)
        lift = at_hits(self._normals, mesh.faces, face, weights) * np.float32(self.tolerance / 2)
        hits = self._solid.first(points + lift, mirrored)
        found = np.full(len(face), -1, np.int64)
        found[hits.rays] = hits.face
        corners = np.zeros((len(face), 3), np.float32)
        corners[hits.rays] = hits.weights
        return found, corners

    def samples(self) -> Samples:
        """All of them.

        Raises:
            MeshError: no view shows any part of the mesh.
        """
        if not self._parts:
            raise MeshError(
                "no view shows any part of the mesh: the mesh and the cameras do not belong "
                "together. Run extract again, or drop the adopted mesh"
            )
        fields = Samples.__dataclass_fields__
        columns: dict[str, Any] = {}
        kept = self._kept()
        for name in fields:
            parts = [getattr(part, name) for part in self._parts]
            columns[name] = None if parts[0] is None else np.concatenate(parts)[kept]
        return Samples(**columns)

    def _kept(self) -> Bools:
        """Which samples count: those near the field, and others where these are the fewer ones."""
        near = np.concatenate(self._near)
        corners = self.mesh.faces[np.concatenate([part.face for part in self._parts])]
        weights = np.concatenate([part.weights for part in self._parts])
        around, links = (
            np.empty((len(self.mesh.vertices), 2), np.float32),
            links_of(self.mesh.faces),
        )
        for column, those in enumerate((near, ~near)):
            rows, counts = corners[those].reshape(-1), weights[those].reshape(-1)
            around[:, column] = np.bincount(rows, counts, len(around))
        for _ in range(_AROUND):
            around = spread(around, links)
        fewer = around[:, 0] < around[:, 1]
        return np.asarray(near | fewer[corners].all(1))


def _shown(field: F32, rows: Ints, photo: F32 | None, lamp: Shone | None) -> F32:
    """(N, 3) linear radiance in the photo, made as bright as the field's, or in a lamp's view.

    Args:
        field: (N, 3) what the field shows at the pixels `rows` (N,).
    """
    if lamp is not None:
        return np.asarray(lamp.radiance.reshape(-1, 3)[rows], np.float32)
    if photo is None:
        return field
    there = linear_from_srgb(photo.reshape(-1, 3)[rows])
    there *= exposure(there, field)
    return np.where(np.isfinite(there), there, field)


def _glint(towards: F32, normal: F32, toward: F32) -> F32:
    """(N, 4) `Samples.glint` of places with unit normals (N, 3).

    Args:
        towards: (N, 3) to the lamp, world units; toward: (N, 3) unit, to the eye.
    """
    square = (towards**2).sum(1, keepdims=True)
    light = towards / np.sqrt(square)
    half = light + toward
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cosines = [(normal * half).sum(1), (normal * light).sum(1), (light * half).sum(1)]
    return np.column_stack([*cosines, 1 / square[:, 0]]).astype(np.float32)


def exposure(photo: F32, field: F32) -> np.float32:
    """The factor that makes a photo as bright as the field, which knows one exposure alone.

    Args:
        photo, field: (N, 3) linear radiance of the same places; NaN where the photo tells nothing.
    """
    told = (np.minimum(photo, field) > _DARK) & (np.maximum(photo, field) < _BRIGHT)
    if told.sum() < _ENOUGH:
        return np.float32(1)
    return np.float32(np.clip(np.median(field[told] / photo[told]), 0.5, 2))


def seen_roughness(roughness: Any, footprint: Any) -> Any:
    """The roughness that a pixel shows of a surface that bends within it; arrays or tensors.

    Slopes of normals within the pixel add to those of the microfacets: alpha^2 is twice their
    variance along one axis (Kaplanyan et al. 2016, "Filtering distributions of normals for
    shading antialiasing").
    """
    return (roughness**4 + footprint).clip(0, 1) ** 0.25


def _squared_curvature(mesh: TriangleMesh, normals: F32) -> F32:
    """(V, 1) mean square of the normal curvature along the edges, 1 / world units squared."""
    links = links_of(mesh.faces)
    for _ in range(_CALMING):
        normals = spread(normals, links)
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    a, b = links.T
    turned = ((normals[a] - normals[b]) ** 2).sum(1)
    length = ((mesh.vertices[a] - mesh.vertices[b]) ** 2).sum(1)
    bent = turned / np.maximum(length, 1e-12)
    total, count = (
        sum(np.bincount(end, weights=w, minlength=len(normals)) for end in (a, b))
        for w in (bent, np.ones(len(links)))
    )
    return np.asarray(total / np.maximum(count, 1), np.float32)[:, None]
