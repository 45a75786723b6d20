"""The light that reaches every vertex of a mesh: from far away, and from the mesh itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.light import Light
from refdgs_pipe.ray_casting import Solid, cosine_rays

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]
_RAYS = 64
_BLUR = 0.35  # roughness: each ray stands for its share of the half sphere, not for a point
_SMOOTHING = 3


@dataclass(frozen=True)
class Sky:
    """What every vertex sees around it.

    Args:
        directions: a ray's direction for each vertex, (rays, V, 3).
        seen: (rays, V) the vertex that it meets, -1 for none.
        links: (E, 2) neighbouring vertices.
    """

    directions: F32
    seen: Ints
    links: Ints

    @property
    def openness(self) -> F32:
        """(V,) share of the rays that meet nothing."""
        share = (self.seen < 0).mean(0)[:, None]
        return self._smooth(share.astype(np.float32))[:, 0]

    def received(self, environment: Light, radiance: F32) -> F32:
        """(V, 3) radiance of a white matte surface there.

        Args:
            radiance: (V, 3) what the mesh's vertices send out.
        """
        total = np.zeros_like(radiance)
        blur = np.full(len(radiance), _BLUR, np.float32)
        for directions, seen in zip(self.directions, self.seen, strict=True):
            far = environment.mirrored(directions, blur)
            total += np.where((seen < 0)[:, None], far, radiance[np.maximum(seen, 0)])
        return self._smooth(np.asarray(total / len(self.seen), np.float32))

    def _smooth(self, values: F32) -> F32:
        """Mean with the neighbours, some times over: takes the rays' noise away."""
        for _ in range(_SMOOTHING):
            values = spread(values, self.links)
        return values


def look_around(vertices: F32, faces: NDArray[np.int32], normals: F32, *, lift: float) -> Sky:
    """Cast rays from every vertex (V, 3) of a mesh with faces (F, 3), denser around its normal.

    Args:
        normals: (V, 3) unit.
        lift: how far above the surface they start, world units.
    """
    solid = Solid(vertices, faces)
    start = vertices + np.float32(lift) * normals
    directions = np.stack([cosine_rays(normals, _RAYS, i) for i in range(_RAYS)])
    seen = np.full((_RAYS, len(start)), -1, np.int64)
    for i, rays in enumerate(directions):
        hits = solid.first(start, rays)
        corner = hits.weights.argmax(1)
        seen[i, hits.rays] = faces[hits.face, corner]
    return Sky(directions, seen, links_of(faces))


def links_of(faces: NDArray[np.int32]) -> Ints:
    """(E, 2) the vertices that edges join, each edge once."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2)
    return np.unique(np.sort(edges.astype(np.int64), axis=1), axis=0)


def spread(values: F32, links: Ints) -> F32:
    """(V, C) the mean of each vertex and the mean of its neighbours."""
    total = np.zeros(values.shape, np.float64)
    count = np.bincount(links.reshape(-1), minlength=len(values))[:, None]
    for column in range(values.shape[1]):
        for here, there in ((0, 1), (1, 0)):
            total[:, column] += np.bincount(
                links[:, here], values[links[:, there], column], minlength=len(values)
            )
    around = np.where(count > 0, total / np.maximum(count, 1), values)
    return np.asarray((values + around) / 2, np.float32)
