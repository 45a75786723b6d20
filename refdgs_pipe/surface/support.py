"""The level surface that the object stands on, and the mesh without it.

A table or a plate is what is level, faces up, reaches out from under what stands on it, and has
something standing on it, more than hangs below it. A box's lid has nothing on it; the bottom of a
cup reaches out from under nothing; a kettle's shoulder carries a knob, and most of the kettle is
below it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.errors import MeshError
from refdgs_pipe.surface.topology import compacted, face_areas, pieces

F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

_TILT_DEG = 20.0  # how far the plane, and a face of it, may lean against the world's up
_THICK = 0.01  # faces this near belong to the plane, in sizes
_LEAST_MARGIN = 0.003  # in sizes: the fillet that fusion leaves where the object meets the table
_LEAST_SHARE = 0.05  # of the mesh's area, that the plane and what stands on it must hold each
_LEAST_OUTSIDE = 0.2  # of the plane's area, that must lie beside what stands on it
_FLAT = 2.0  # of _THICK: what rises no higher is a bump of the support
_PLANES = 5  # level planes that are looked at: lids and shelves can be larger than the table
_POINTS = 20_000

NONE_FOUND = (
    "clean.keep=object: found no level surface that something stands on, so that everything is "
    "kept. If a table is left, photograph more of it, check the up axis (gate.up), mask the "
    "photos, or cut the mesh and adopt it"
)

NO_GROUND = (
    "clean.base=closed: the base stays open, because the ground is not known, belongs to the "
    "object, or all photos were taken from one side. Take photos all round the object on a "
    "textured table, or close the mesh in another program and adopt it"
)


@dataclass(frozen=True)
class Support:
    """The plane of points x with normal . x = offset; the normal is unit and points up.

    Args:
        margin: what is lower than this above the plane is the support, world units.
        bump: pieces that rise no higher belong to it too, world units.
        share: of the mesh's area, that lies on the plane.
    """

    normal: F64
    offset: float
    margin: float
    bump: float
    share: float

    def heights(self, points: NDArray[np.floating]) -> F64:
        """(...) signed distances of points (..., 3)."""
        return np.asarray(points @ self.normal - self.offset, np.float64)


def find_support(mesh: TriangleMesh, up: F64, size: float) -> Support | None:
    """The largest plane that something stands on, or None.

    RANSAC (open3d) on places spread over the faces that look up, then least squares.

    Args:
        up: (3,) unit, world.
        size: the object ball's diameter, world units.
    """
    areas = face_areas(mesh.vertices, mesh.faces)
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    centers, normals = (a + b + c) / 3, np.cross(b - a, c - a)
    cosine = (normals @ up) / np.maximum(2 * areas, 1e-30)
    level = (cosine > np.cos(np.radians(_TILT_DEG))) & (areas > 0)
    for _ in range(_PLANES):
        if areas[level].sum() < _LEAST_SHARE * areas.sum():
            return None
        normal, offset = _largest_plane(centers[level], areas[level], up, size)
        heights = centers @ normal - offset
        on = level & (np.abs(heights) < _THICK * size)
        level &= ~on
        if not on.any():
            return None
        noise = 1.4826 * float(np.median(np.abs(heights[on])))
        margin = float(np.clip(4 * noise, _LEAST_MARGIN * size, _THICK * size))
        share = float(areas[on].sum() / areas.sum())
        support = Support(normal, offset, margin, _FLAT * _THICK * size, share)
        above, below = heights > _THICK * size, heights < -_THICK * size
        level_enough = normal @ up > np.cos(np.radians(_TILT_DEG))
        if (
            level_enough
            and areas[below].sum() <= areas[above].sum()
            and _carries(support, centers, areas, on, above)
        ):
            return support
    return None


def above_support(mesh: TriangleMesh, support: Support) -> TriangleMesh:
    """What stands on the support, cut off where it begins and drawn down to the plane.

    It is open below, where no photo sees it. Bumps of the support go with it.

    Raises:
        MeshError: nothing rises from it.
    """
    import open3d as o3d

    solid = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(mesh.vertices, np.float32)),
        o3d.core.Tensor.from_numpy(np.ascontiguousarray(mesh.faces, np.int32)),
    )
    level = support.normal * (support.offset + support.margin)
    cut = solid.clip_plane(point=level.tolist(), normal=support.normal.tolist())
    if not len(cut.triangle):
        raise MeshError("nothing rises from the support: use clean.keep=all")
    vertices = cut.vertex.positions.numpy().astype(np.float64)
    kept = compacted(vertices, cut.triangle.indices.numpy())
    piece = pieces(kept)
    heights = support.heights(kept.vertices)
    top = np.zeros(int(piece.max(initial=-1)) + 1)
    np.maximum.at(top, piece, heights[kept.faces].max(1))
    rises = top[piece] > support.bump
    if not rises.any():
        raise MeshError("nothing rises from the support: use clean.keep=all")
    foot = heights < support.margin * (1 + 1e-3)
    drawn_down = kept.vertices - np.where(foot, heights, 0)[:, None] * support.normal
    return compacted(drawn_down, kept.faces[rises])


def figures(support: Support | None) -> list[tuple[str, float, str]]:
    """What to tell of it: name, value, unit."""
    if support is None:
        return []
    return [
        ("support's share of the area", round(support.share, 4), ""),
        ("cut above the support", round(support.margin, 5), "world units"),
    ]


def _largest_plane(points: F64, areas: F64, up: F64, size: float) -> tuple[F64, float]:
    """Unit normal, upwards, and offset of the plane that holds most of the area."""
    import open3d as o3d

    chance = np.random.default_rng(0)
    drawn = points[np.sort(chance.choice(len(points), _POINTS, p=areas / areas.sum()))]
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(drawn))
    o3d.utility.random.seed(0)
    # The probability of one keeps it from stopping early, which threads would decide.
    plane, _ = cloud.segment_plane(_THICK * size, 3, 500, probability=1.0)
    normal, offset = np.array(plane[:3], np.float64), -float(plane[3])
    for _ in range(10):
        on = drawn[np.abs(drawn @ normal - offset) < _THICK * size]
        if len(on) < 3:
            break
        normal = np.asarray(np.linalg.svd(on - on.mean(0), full_matrices=False)[2][2])
        offset = float(normal @ on.mean(0))
    return (normal, offset) if normal @ up > 0 else (-normal, -offset)


def _carries(support: Support, centers: F64, areas: F64, on: Bools, above: Bools) -> bool:
    """Whether the plane is large, something stands on it, and it reaches out from under that."""
    from scipy.spatial import ConvexHull, QhullError

    least = _LEAST_SHARE * areas.sum()
    if areas[on].sum() < least or areas[above].sum() < least:
        return False
    across = np.linalg.svd(support.normal[None])[2][1:]
    try:
        hull = ConvexHull(centers[above] @ across.T)
    except QhullError:  # what stands there is a line
        return True
    beside = (centers[on] @ across.T @ hull.equations[:, :2].T + hull.equations[:, 2]).max(1) > 0
    return float(areas[on][beside].sum()) >= _LEAST_OUTSIDE * float(areas[on].sum())
