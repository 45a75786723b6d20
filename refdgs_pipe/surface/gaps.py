"""What no view sees, between what they see: solid, unless a view looks through it.

Fusion makes a surface only where enough views measure its depth. Below a bulge and beside the
foot few do, and the mesh is torn there. What views say of empty space reaches further: all that
lies before a measured depth is empty, and all that shows beside the object. Near the torn rims
the border between empty space and the rest becomes surface (Curless and Levoy 1996, section 4).
On the ground that the object stands on, this makes a narrow brim of its base.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from refdgs_pipe.artifacts.mesh import RawMesh, TriangleMesh
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.geometry import outline_distance
from refdgs_pipe.irradiance import links_of
from refdgs_pipe.surface.rims import rim_of
from refdgs_pipe.surface.topology import compacted

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

REACH = 0.12  # of the ball's diameter, from a torn rim
_BRIM = 1.5  # of REACH: so wide, along the surface, is a brim that hangs from one side, at most
_LONGEST = 480  # pixels of the maps that are kept
_SURE = 3  # views that have to see that a place is empty
_THIN = 2e-4  # of the ball's diameter, off the ground, for what lies on it
_LOW = 3e-3  # of the ball's diameter: a rim that lies lower is on the ground
_SAME = 1e-3  # of the ball's diameter, by which fusion's own surface may move beside a gap
_ROW = 1024  # points that are looked up in one row


@dataclass(frozen=True)
class Glance:
    """What one view says of empty space.

    Args:
        depth: (H, W) where it is measured, else 0.
        beside: (H, W) pixels to the object's outline; positive outside of it.
    """

    camera: Camera
    depth: F32
    beside: F32

    @classmethod
    def of(cls, view: SurfaceMap, depth: F32, min_alpha: float) -> "Glance":
        """From a view and its usable depth."""
        camera = view.camera.fitted(_LONGEST)
        size = (camera.width, camera.height)
        covered = cv2.resize(view.alpha.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        # Linear between the pixels on both sides, so that the outline is not on a raster.
        beside = -outline_distance(covered >= min_alpha)
        near = cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST)
        return cls(camera, np.asarray(near, np.float32), beside)

    def emptiness(self, points: F64, band: float) -> F32:
        """(N,) world units by which this view sees that points (N, 3) are empty.

        Negative: as far as it sees they are not; -band where it sees nothing of them.
        """
        uv, z = self.camera.project(points)
        height, width = self.depth.shape
        seen = (z > 0) & (uv >= 0.5).all(1) & (uv[:, 0] <= width - 0.5) & (uv[:, 1] <= height - 0.5)
        u, v = (np.where(seen, uv[:, i] - 0.5, 0).astype(np.float32) for i in (0, 1))
        beside = _looked_up(self.beside, u, v, cv2.INTER_LINEAR)
        depth = _looked_up(self.depth, u, v, cv2.INTER_NEAREST)
        past = beside * z / float(self.camera.K[0, 0])
        before = np.where(depth > 0, depth - z, -band)
        out = np.where(seen, np.maximum(past, before), -band)
        return np.asarray(np.clip(out, -band, band), np.float32)


class Gaps:
    """Where fusion may close what no view sees, and the signed distances there.

    Args:
        ball: nothing outside it is closed.
        ground: (3,) unit normal of the plane through the world's origin that the object stands on.
        band: the largest distance that counts, world units.
    """

    def __init__(self, ball: Ball, ground: F64, band: float) -> None:
        self.ball, self.ground, self.band = ball, ground, band
        self._reach = REACH * 2 * ball.radius
        self._glances: list[Glance] = []

    def add(self, view: SurfaceMap, depth: F32, min_alpha: float) -> None:
        """Take one more view, with its usable depth (H, W)."""
        self._glances.append(Glance.of(view, depth, min_alpha))

    def blocks(self, rim: F64, edge: float) -> NDArray[np.int32]:
        """(M, 3) the blocks of a grid that may hold gaps, for the mesh's rims (N, 3).

        Args:
            edge: of a block, world units.
        """
        low = np.floor((self.ball.center - self.ball.radius) / edge).astype(np.int32)
        high = np.ceil((self.ball.center + self.ball.radius) / edge).astype(np.int32)
        axes = [np.arange(a, b, dtype=np.int32) for a, b in zip(low, high, strict=True)]
        keys = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        reach = self._reach + edge * 3**0.5 / 2
        near = cKDTree(rim).query((keys + 0.5) * edge, distance_upper_bound=reach)[0] < np.inf
        return np.asarray(keys[near], np.int32)

    def among(self, points: F64, rim: F64) -> NDArray[np.bool_]:
        """(N,) the points (N, 3) where gaps are closed."""
        near = cKDTree(rim).query(points, distance_upper_bound=self._reach)[0] < np.inf
        inside = ((points - self.ball.center) ** 2).sum(-1) < self.ball.radius**2
        return np.asarray(inside & near)

    def distances(self, points: F64) -> F32:
        """(N,) of points (N, 3), in bands: 1 is empty, 0 the surface, -1 solid."""
        return emptiness(self._glances, points, self.band) / np.float32(self.band)

    def depths(self, points: F64, more: float = 0.0) -> F32:
        """(N,) how far points (N, 3) lie in the ground, in bands; no object is there.

        Args:
            more: added to all depths, world units.
        """
        return np.asarray(np.clip((more - points @ self.ground) / self.band, -1, 1), np.float32)


def emptiness(glances: list[Glance], points: F64, band: float) -> F32:
    """(N,) world units by which enough views see that points (N, 3) are empty; at most `band`."""
    most = np.full((min(_SURE, len(glances)), len(points)), -band, np.float32)  # in order
    for glance in glances:
        one = glance.emptiness(points, band)
        for row in most:
            lower = np.minimum(row, one)
            np.maximum(row, one, out=row)
            one = lower
    return np.asarray(most[-1], np.float32)


def only_bridges(closed: RawMesh, torn: RawMesh, ground: F64, diameter: float) -> RawMesh:
    """A mesh with closed gaps, without what hangs from one side of a gap only.

    Such a brim says nothing of the object: below a lamp's shade it is a lid that ends in the air.
    Added faces go within the width of a brim from each rim that is not on the ground.

    Args:
        closed, torn: the mesh with closed gaps, and before; (3,) ground as in `Gaps`.
        diameter: of the object ball, world units.
    """
    points = closed.vertices.astype(np.float64)
    added = cKDTree(torn.vertices).query(points)[0] > _SAME * diameter
    rim = rim_of(closed).vertices
    free = rim[np.abs(points[rim] @ ground) > _LOW * diameter]
    links = links_of(closed.faces)
    links = links[added[links].any(1)]
    a, b = links.T
    length = np.linalg.norm(points[a] - points[b], axis=1)
    net = csr_array((length, (a, b)), shape=(len(points), len(points)))
    if not len(free):
        return closed
    away = dijkstra(
        net, directed=False, indices=free, min_only=True, limit=_BRIM * REACH * diameter
    )
    gone = added & np.isfinite(away)
    kept = compacted(closed.vertices, closed.faces[~gone[closed.faces].any(1)])
    return RawMesh(kept.vertices, kept.faces)


def without_base(mesh: TriangleMesh, ground: F64, diameter: float) -> TriangleMesh:
    """The mesh as `Gaps` closed it, open on the ground.

    Args:
        ground: (3,) unit normal of the plane through the origin.
        diameter: of the object ball, world units.
    """
    low = np.abs(mesh.vertices.astype(np.float64) @ ground) < _THIN * diameter
    return compacted(mesh.vertices, mesh.faces[~low[mesh.faces].all(1)])


def _looked_up(image: F32, u: F32, v: F32, how: int) -> F32:
    """(N,) an image's value at pixels (N,), whose centres are whole numbers."""
    count = len(u)
    pad = -count % _ROW
    u, v = (np.pad(x, (0, pad)).reshape(-1, _ROW) for x in (u, v))
    return np.asarray(cv2.remap(image, u, v, how).reshape(-1)[:count], np.float32)
