"""A mesh against the true surface, in the two protocols of docs/evaluation.md."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.scores import SurfaceScore
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.camera import Camera
from refdgs_pipe.evaluation.wholeness import confidence_at
from refdgs_pipe.geometry import spread_over
from refdgs_pipe.metrics import SurfaceDistances, nearest, rank_correlation, worst_part

F64 = NDArray[np.float64]

PAPER_VOXEL = 0.01  # world units
SAMPLES = 200_000  # of each mesh
SEED = 0
NEIGHBOURHOOD = 0.05  # of the truth's diagonal: what lies further off is no part of the object
PART = 0.1  # of the diagonal: edge of the parts among which the worst is named
PART_SHARE = 0.002  # of the surface, of a part that counts
HIDDEN_SHARE = 1e-3  # of the distance to the camera: what lies this far behind a surface is hidden


class Surface:
    """A mesh that rays can hit, and that the given cameras see."""

    def __init__(self, mesh: TriangleMesh, cameras: Sequence[Camera]) -> None:
        import open3d as o3d

        self.mesh, self.cameras = mesh, cameras
        self._tensor = o3d.core.Tensor.from_numpy
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(mesh.vertices, np.float32)),
            self._tensor(np.ascontiguousarray(mesh.faces, np.uint32)),
        )

    def seen_points(self, voxel: float) -> F64:
        """(P, 3) what all cameras' pixel centres hit, averaged in each voxel of a grid.

        The grid stands still in the world, whatever the mesh: a point at the origin is a corner.
        """
        low = np.floor(self.mesh.vertices.min(0).astype(np.float64) / voxel).astype(np.int64) - 1
        high = np.floor(self.mesh.vertices.max(0).astype(np.float64) / voxel).astype(np.int64) + 2
        shape = tuple(int(n) for n in high - low)
        parts = []
        for camera in self.cameras:
            points = self._hits(camera)
            cells = np.clip(np.floor(points / voxel).astype(np.int64) - low, 0, high - low - 1)
            parts.append(_sums(np.ravel_multi_index(tuple(cells.T), shape), points, 1.0))
        if not parts:
            return np.zeros((0, 3))
        keys, sums, counts = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        _, sums, counts = _sums(keys, sums, counts)
        return np.asarray(sums / counts[:, None])

    def seen_samples(self, count: int, seed: int) -> F64:
        """(P, 3) of `count` points spread evenly over the area, those that a camera sees."""
        points = sampled(self.mesh, count, seed)
        seen = np.zeros(len(points), bool)
        for camera in self.cameras:
            unseen = np.flatnonzero(~seen)
            seen[unseen] = self._sees(camera, points[unseen])
        return points[seen]

    def distances(self, points: F64) -> F64:
        """(N,) unsigned distance of points (N, 3) to the nearest place on the mesh."""
        found = self._scene.compute_distance(self._tensor(points.astype(np.float32)))
        return np.asarray(found.numpy(), np.float64)

    def _hits(self, camera: Camera) -> F64:
        """(P, 3) where the rays through the camera's pixel centres meet the mesh."""
        towards = camera.pixel_rays().reshape(-1, 3) @ camera.cam_from_world[:3, :3]
        hits = self._scene.cast_rays(self._rays(camera, towards))["t_hit"].numpy()
        there = np.isfinite(hits)
        return np.asarray(camera.center + hits[there, None].astype(np.float64) * towards[there])

    def _sees(self, camera: Camera, points: F64) -> NDArray[np.bool_]:
        uv, depth = camera.project(points)
        size = (camera.width, camera.height)
        inside = (depth > 0) & (uv >= 0).all(1) & (uv < size).all(1)
        rays = self._rays(camera, points[inside] - camera.center)
        hidden = self._scene.test_occlusions(rays, 0.0, 1.0 - HIDDEN_SHARE).numpy()
        inside[inside] = ~hidden
        return np.asarray(inside)

    def _rays(self, camera: Camera, towards: F64) -> Any:
        origins = np.broadcast_to(camera.center, towards.shape)
        return self._tensor(np.concatenate([origins, towards], 1).astype(np.float32))


def score_surface(
    mesh: TriangleMesh,
    cameras: Sequence[Camera],
    true_mesh: TriangleMesh | None,
    true_points: F64 | None = None,
    *,
    paper: bool = True,
    among_others: bool = False,
    textured: TexturedMesh | None = None,
) -> SurfaceScore | None:
    """Compare a mesh with the true one, all in one world frame.

    Args:
        cameras: the training views, at the size that they are rasterised in.
        true_points: (P, 3) the data set's own points for the paper's protocol; without them the
            true mesh is rasterised as the result is.
        paper: whether there is a figure in the paper's protocol, whose grid has the world's unit.
        among_others: the mesh also holds what the object stands on, which the truth does not: the
            samples of the mesh that are further than NEIGHBOURHOOD from the truth do not count.
        textured: the mesh with its textures, whose confidence is compared with the distances.

    Returns:
        None if the cameras see nothing of the mesh, or of the truth.
    """
    result = Surface(mesh, cameras)
    points = result.seen_points(PAPER_VOXEL)
    if not len(points):
        return None
    if true_mesh is None:
        return None if true_points is None else _paper_score(points, true_points)
    truth = Surface(true_mesh, cameras)
    targets = truth.seen_points(PAPER_VOXEL) if true_points is None else true_points
    samples = result.seen_samples(SAMPLES, SEED)
    true_samples = truth.seen_samples(SAMPLES, SEED)
    if not (len(targets) and len(samples) and len(true_samples)):
        return None
    diagonal = _diagonal(true_mesh.vertices[np.unique(true_mesh.faces)])
    to_truth = truth.distances(samples)
    near = to_truth < NEIGHBOURHOOD * diagonal
    if among_others:
        samples, to_truth = samples[near], to_truth[near]
        if not near.any():
            return None
    doubt = None if textured is None else -confidence_at(textured, samples)
    between = SurfaceDistances(to_truth, result.distances(true_samples))
    return SurfaceScore(
        diagonal,
        _between_points(points, targets) if paper else None,
        between.chamfer,
        accuracy=between.accuracy,
        completeness=between.completeness,
        median_accuracy=between.medians[0],
        median_completeness=between.medians[1],
        worst_accuracy=_worst(samples, to_truth, diagonal),
        worst_completeness=_worst(true_samples, between.to_result, diagonal),
        f_score_half_percent=between.f_score(0.005 * diagonal),
        f_score_one_percent=between.f_score(0.01 * diagonal),
        left_out=1 - float(near.mean()) if among_others else None,
        confidence_rank=None if doubt is None else rank_correlation(doubt, to_truth),
    )


def _paper_score(points: F64, true_points: F64) -> SurfaceScore:
    """The figure in the paper's protocol alone, of points (N, 3) and the truth's (P, 3)."""
    return SurfaceScore(_diagonal(true_points), _between_points(points, true_points))


def _between_points(points: F64, others: F64) -> float:
    """The Chamfer distance between two sets of points (N, 3) and (M, 3)."""
    return SurfaceDistances(nearest(points, others), nearest(others, points)).chamfer


def sampled(mesh: TriangleMesh, count: int, seed: int) -> F64:
    """(count, 3) points spread evenly over a mesh's area; the same for the same mesh and seed."""
    vertices = mesh.vertices.astype(np.float64)
    face, weights = spread_over(vertices, mesh.faces, count, seed)
    return np.asarray(np.einsum("nk,nkc->nc", weights, vertices[mesh.faces[face]]))


def _worst(points: F64, distances: F64, diagonal: float) -> float:
    """Mean distance in the worst part that is large enough, in the points' unit."""
    least = max(1, round(PART_SHARE * len(points)))
    return worst_part(points, distances, edge=PART * diagonal, least=least)


def _diagonal(points: NDArray[Any]) -> float:
    return float(np.linalg.norm(points.max(0).astype(np.float64) - points.min(0)))


def _sums(
    keys: NDArray[np.int64], values: F64, weights: F64 | float
) -> tuple[NDArray[np.int64], F64, F64]:
    """The distinct keys, and the sums of values (N, 3) and weights (N,) of each."""
    distinct, place = np.unique(keys, return_inverse=True)
    count = len(distinct)
    columns = [*values.T, np.broadcast_to(weights, keys.shape)]
    columns = [np.asarray(np.bincount(place, c, count), np.float64) for c in columns]
    sums = np.stack(columns, -1)
    return distinct, sums[:, :3], sums[:, 3]
