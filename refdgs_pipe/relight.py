"""The exported asset drawn in its exported light: a small renderer of its own.

Metallic-roughness as glTF defines it, with the split sum (`refdgs_pipe.light`): light from far
away, blurred as the roughness asks; where a mirrored ray meets the object, what the object sends
from there; and for the matte part the light gathered over the half sphere, bounces included.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.lighting import WORLD, Lighting, angle_of, turned
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.asset_textures import AssetTextures, Shaded, material_of
from refdgs_pipe.camera import Camera
from refdgs_pipe.color import srgb_from_linear
from refdgs_pipe.far_light import FarLight, ground_seen
from refdgs_pipe.ground_light import GroundLight
from refdgs_pipe.irradiance import Sky, look_around
from refdgs_pipe.lamp import Lamp
from refdgs_pipe.light import (
    Environment,
    Light,
    Turned,
    passed_share,
    reflected_share,
)
from refdgs_pipe.ray_casting import Hits, Solid, at_hits, half_vectors
from refdgs_pipe.vectors import unit

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]
_SUPERSAMPLING = 2
_STEEP = 0.04  # sRGB: pixels whose rays differ by more get four times as many
_BOUNCES = 3
_REFLECTIONS = 1  # of mirrored rays after the first, on the object itself
_BLUNT = 0.15  # roughness from which a place mirrors more than one ray; at twice that, only a lobe
LOBE = 8  # rays of a lobe
_LIFT = 0.0025  # of the object's diagonal: mirrored rays start this far above the surface
_CHUNK = 1 << 18
_ROOM_STEP = 10.0  # degrees between rooms for which the light on matte surfaces is gathered


@dataclass(frozen=True)
class Seen:
    """How N places look.

    Args:
        here: their materials; cosine: (N,) between the normal and the way to the eye.
        received: (N, 3) linear radiance of a white matte surface there, without what the layer
            above it mirrors of it.
        mirrored: (N, 3) linear radiance that is mirrored to the eye.
    """

    here: Shaded
    cosine: F32
    received: F32
    mirrored: F32


class Relit:
    """A textured mesh in its environment.

    Args:
        textured: its textures are rounded to 8 bits, as the files have them.
        environment: (H, 2H, 3) linear radiance, laid out as `refdgs_pipe.light` says, in the frame
            where it stands still.
        lighting: how the light moves; white, ground: of `Appearance`.
        threads: that draw; the picture does not depend on it.
    """

    def __init__(
        self,
        textured: TexturedMesh,
        environment: F32,
        *,
        lighting: Lighting = WORLD,
        white: float = 0.0,
        ground: GroundLight | None = None,
        threads: int = 1,
    ) -> None:
        self.threads = max(1, threads)
        self.lighting, self.white, self.ground = lighting, white, ground
        self.lamp: Lamp | None = None
        self._rooms: dict[int, tuple[F32, F32]] = {}
        self.mesh, self.tangents = textured.mesh, textured.tangents
        self.solid = Solid(self.mesh.vertices, self.mesh.faces)
        self.light: Light = Environment(environment)
        self._beside: FarLight | None = None
        if ground is not None:
            _, known = ground_seen(ground, self.mesh.vertices, len(environment))
            self._beside = FarLight(environment.reshape(-1, 3), known)
        self._textures = AssetTextures(
            textured.base_color, textured.roughness, textured.metallic, textured.normal
        )
        self.lift = np.float32(_LIFT * np.linalg.norm(np.ptp(self.mesh.vertices, axis=0)))
        self._sky, self._first, self._same = self._look()
        alone = np.asarray((self._sky.seen < 0).all(0))
        self._alone = alone[self._same]  # vertices that see nothing of the object
        self._received, self._sent = self._gathered(self.light)

    def under(self, camera: Camera) -> "Relit":
        """The same in the light of a photo that the camera takes, where that moves."""
        if (flash := self.lighting.flash) is None and self.lighting.turntable is None:
            return self
        other = copy(self)
        if flash is not None and (place := self.lighting.lamp_of(camera)) is not None:
            other.lamp = Lamp(place, flash.distance, self.white, flash.room)
            return other
        turn = self.lighting.light_from_world(camera.center)
        assert self.lighting.turntable is not None
        angle = np.degrees(angle_of(turn, self.lighting.turntable.axis))
        step = round(float(angle) / _ROOM_STEP)
        if step not in self._rooms:
            near = turned(self.lighting.turntable.axis, np.radians(step * _ROOM_STEP))
            self._rooms[step] = self._gathered(Turned(self.light, near))
        other.light = Turned(self.light, turn)
        other._received, other._sent = self._rooms[step]
        return other

    def _look(self) -> tuple[Sky, Ints, Ints]:
        """What places see of the object and around it; a vertex of each; the place of each."""
        mesh = self.mesh
        points, first, same = np.unique(
            mesh.vertices, axis=0, return_index=True, return_inverse=True
        )
        same = same.reshape(-1).astype(np.int64)
        faces = same[mesh.faces].astype(np.int32)
        sky = look_around(points, faces, mesh.normals[first], lift=float(self.lift))
        return sky, first, same

    def _gathered(self, light: "Light") -> tuple[F32, F32]:
        """(V, 3) light that reaches each vertex as a matte surface shows it, and what it sends."""
        sky, same = self._sky, self._same
        here = self._at(self.mesh.uv[self._first])
        typical = np.full((len(here.base), 1), 0.7, np.float32)
        share = here.scattered * passed_share(here.roughness, typical)
        share += reflected_share(here.f0, here.roughness, typical)
        sent = np.zeros_like(here.base)
        received = sent
        for _ in range(_BOUNCES):
            received = sky.received(light, sent) if not self.white else sent + self.white
            sent = received * share
        return received[same], sent[same]

    def draw(self, camera: Camera) -> tuple[F32, F32]:
        """(H, W, 3) sRGB picture, not premultiplied, and (H, W) coverage.

        Pixels whose rays differ much get more of them. Light that moves is as the camera's photo
        would have it.
        """
        return self.under(camera)._drawn(camera)

    def _drawn(self, camera: Camera) -> tuple[F32, F32]:
        """`draw` in this light."""
        whole = np.arange(camera.width * camera.height)
        mean, apart = self._looked(camera, whole, _SUPERSAMPLING)
        steep = np.flatnonzero(apart > _STEEP)
        mean[steep], _ = self._looked(camera, steep, 2 * _SUPERSAMPLING)
        image = mean.reshape(camera.height, camera.width, 4)
        alpha = image[..., 3]
        linear = image[..., :3] / np.maximum(alpha, np.float32(1e-6))[..., None]
        return srgb_from_linear(np.asarray(linear, np.float32)), alpha

    def _looked(self, camera: Camera, pixels: Ints, side: int) -> tuple[F32, F32]:
        """(N, 4) linear colour times coverage, and coverage; (N,) how far rays lie apart, sRGB.

        Args:
            pixels: (N,) row * width + column; side: rays along a pixel's side.
        """
        total = np.zeros((len(pixels), 4), np.float32)
        low = np.full((len(pixels), 4), np.inf, np.float32)
        high = -low
        shared = min(side * side, LOBE)

        def met(number: int) -> F32:
            rays = rays_of(camera, pixels, offsets(side)[number])
            return self._met(camera, rays, range(number % shared, LOBE, shared))

        with ThreadPoolExecutor(self.threads) as pool:
            for found in pool.map(met, range(side * side)):
                total += found
                shown = srgb_from_linear(found)
                low, high = np.minimum(low, shown), np.maximum(high, shown)
        return total / np.float32(side * side), (high - low).max(1)

    def _met(self, camera: Camera, rays: F32, lobe: range) -> F32:
        """(N, 4) linear colour and 1 where rays (N, 3) from the camera meet the object, else 0.

        Args:
            lobe: which rays of a lobe are followed.
        """
        hits = self.solid.first(camera.center.astype(np.float32), rays)
        found = np.zeros((len(rays), 4), np.float32)
        for start in range(0, len(hits.rays), _CHUNK):
            some = hits.chosen(slice(start, start + _CHUNK))
            shaded = self._shade(some, -rays[some.rays], lobe)
            found[some.rays] = np.column_stack([np.clip(shaded, 0, 1), np.ones(len(shaded))])
        return found

    def surface(self, hits: Hits, toward: F32, lobe: range) -> Seen:
        """What makes up the radiance towards the eye, (N, 3) unit, of places that were met.

        Args:
            lobe: which rays of a lobe are followed.
        """
        mesh = self.mesh

        def at(values: F32) -> F32:
            return at_hits(values, mesh.faces, hits.face, hits.weights)

        uv, plain = at(mesh.uv), at(mesh.normals)
        texels = self._textures.at(uv)
        here, local = material_of(texels), texels[:, 5:] * 2 - 1
        tangent = at(self.tangents[:, :3])
        sign = self.tangents[mesh.faces[hits.face, 0], 3:]
        normal = local[:, :1] * tangent + local[:, 1:2] * np.cross(plain, tangent) * sign
        normal = unit(normal + local[:, 2:] * plain)
        along = (normal * toward).sum(1, keepdims=True)
        mirrored = unit(2 * along * normal - toward)
        rough = here.roughness[:, 0]
        start = at(mesh.vertices) + self.lift * unit(plain)
        incoming = self._around(start, mirrored, rough)
        near = self.solid.first(start, mirrored)
        sharp = np.array(incoming)
        sharp[near.rays] = self._seen(near, mirrored[near.rays], _REFLECTIONS)
        crowded = ~self._alone[mesh.faces[hits.face]].all(1)
        blunt = np.flatnonzero(crowded & (rough > _BLUNT))
        some = (start[blunt], normal[blunt], toward[blunt], rough[blunt])
        incoming, far = sharp, incoming[blunt]
        incoming[blunt] = self._blunted(far, sharp[blunt], *some, lobe)
        cosine = np.clip(along, 0.02, 1)
        share = reflected_share(here.f0, here.roughness, cosine)
        passed = passed_share(here.roughness, cosine)
        if self.lamp is None:
            return Seen(here, along[:, 0], at(self._received) * passed, incoming * share)
        points = at(mesh.vertices)
        lit = np.repeat(self.lamp.received(points, normal), 3, axis=1)
        spot = self.lamp.mirrored(points, normal, toward, here.f0, here.roughness)
        return Seen(here, along[:, 0], lit * passed, incoming * share + spot)

    def _shade(self, hits: Hits, toward: F32, lobe: range) -> F32:
        """(N, 3) linear radiance towards the eye, (N, 3) unit."""
        seen = self.surface(hits, toward, lobe)
        return seen.here.scattered * seen.received + seen.mirrored

    def _blunted(
        self,
        far: F32,
        sharp: F32,
        points: F32,
        normal: F32,
        toward: F32,
        roughness: F32,
        lobe: range,
    ) -> F32:
        """(N, 3) what rough places mirror: some rays of their lobe, and not one alone.

        The rays that meet the object count with what they meet, the others with the far light,
        which is blurred already. Rays into the surface do not count.

        Args:
            far, sharp: (N, 3) without the object, and with what one ray meets of it.
            points: (N, 3) where rays start; normal, toward: (N, 3) unit, `toward` to the eye.
            roughness: (N,).
            lobe: which of the lobe's rays.
        """
        total = np.zeros_like(far)
        count = np.zeros((len(far), 1), np.float32)
        for i in lobe:
            half = half_vectors(normal, roughness[:, None] ** 2, LOBE, i)
            way = unit(2 * (toward * half).sum(1, keepdims=True) * half - toward)
            above = (way * normal).sum(1, keepdims=True) > 0
            shown = np.array(far)
            hits = self.solid.first(points, way)
            shown[hits.rays] = self._seen(hits, way[hits.rays], 0)
            total += np.where(above, shown, 0)
            count += above
        most = np.clip((roughness - _BLUNT) / _BLUNT, 0, 1)[:, None] * (count > 0)
        return np.asarray(sharp + most * (total / np.maximum(count, 1) - sharp), np.float32)

    def _around(self, points: F32, directions: F32, roughness: F32) -> F32:
        """(N, 3) light that mirrored rays (N, 3) from points (N, 3) meet beside the object."""
        if self._beside is None or self.ground is None:
            return self.light.mirrored(directions, roughness)
        return self._beside.mirrored(self.ground, points, directions, roughness)

    def _seen(self, hits: Hits, directions: F32, more: int) -> F32:
        """(N, 3) linear radiance that mirrored rays (N, 3) meet on the object.

        Args:
            more: further reflections that are followed; after these, what vertices send on average.
        """
        mesh = self.mesh

        def at(values: F32) -> F32:
            return at_hits(values, mesh.faces, hits.face, hits.weights)

        if not more:
            return at(self._sent)
        here, normal = self._at(at(mesh.uv)), unit(at(mesh.normals))
        along = -(normal * directions).sum(1, keepdims=True)
        onward = unit(directions + 2 * along * normal)
        start = at(mesh.vertices) + self.lift * normal
        incoming = self._around(start, onward, here.roughness[:, 0])
        near = self.solid.first(start, onward)
        incoming[near.rays] = self._seen(near, onward[near.rays], more - 1)
        cosine = np.clip(along, 0.02, 1)
        received = at(self._received) * passed_share(here.roughness, cosine)
        share = reflected_share(here.f0, here.roughness, cosine)
        return np.asarray(here.scattered * received + incoming * share, np.float32)

    def _at(self, uv: F32) -> Shaded:
        """The material at texture coordinates (N, 2)."""
        return material_of(self._textures.at(uv))


def relit(
    textured: TexturedMesh, looks: Appearance, *, threads: int = 1
) -> Callable[[Camera], tuple[F32, F32]] | None:
    """What draws a textured mesh in the light that it was told from; None if there is none.

    Args:
        threads: that draw; the picture does not depend on it.
    """
    if looks.environment is None:
        return None
    return in_its_light(textured, looks, threads=threads).draw


def in_its_light(textured: TexturedMesh, looks: Appearance, *, threads: int = 1) -> Relit:
    """A textured mesh in the light of an appearance, whose environment must be known."""
    assert looks.environment is not None
    return Relit(
        textured,
        looks.environment,
        lighting=looks.lighting,
        white=looks.white,
        ground=looks.ground,
        threads=threads,
    )


def offsets(side: int) -> list[tuple[float, float]]:
    """Where in a pixel `side` x `side` rays go, from its centre, to the right and downwards."""
    steps = [(i + 0.5) / side - 0.5 for i in range(side)]
    return [(x, y) for y in steps for x in steps]


def rays_of(camera: Camera, pixels: Ints, offset: tuple[float, float] = (0.0, 0.0)) -> F32:
    """(N, 3) unit rays, world, through pixels (N,) given as row * width + column.

    Args:
        offset: from their centres, in pixels to the right and downwards.
    """
    row, column = np.divmod(pixels, camera.width)
    x, y = column + 0.5 + offset[0], row + 0.5 + offset[1]
    towards = np.column_stack([x, y, np.ones(len(pixels))]) @ np.linalg.inv(camera.K).T
    return unit((towards @ camera.cam_from_world[:3, :3]).astype(np.float32))
