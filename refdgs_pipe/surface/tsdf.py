"""Fusion of depth maps into one surface on a sparse grid of signed distances."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import RawMesh
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.errors import MeshError
from refdgs_pipe.geometry import without_jumps
from refdgs_pipe.surface.gaps import Gaps, only_bridges
from refdgs_pipe.surface.rims import rim_of

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Smaller blocks waste less on the empty side of a thin surface: 8 took a third less memory than 16.
_BLOCK = 8


class Volume:
    """A grid that takes one view's depth after another and gives their common surface.

    Args:
        ball: only what lies inside it is fused.
        voxel: edge of a voxel, in diameters of the ball.
        band: half-width of the signed-distance band, in voxels.
        min_alpha: pixels covered less are ignored.
        min_cosine: pixels seen flatter than this (cosine to the normal) are ignored.
        ground: (3,) unit normal of the plane through the world's origin that the object stands on,
            if views show the object alone: then gaps between what views see are closed down to it.
    """

    def __init__(
        self,
        ball: Ball,
        *,
        voxel: float,
        band: float = 4.0,
        min_alpha: float = 0.5,
        min_cosine: float = 0.15,
        ground: F64 | None = None,
    ) -> None:
        import open3d as o3d

        self.ball, self.band = ball, band
        self.min_alpha, self.min_cosine = min_alpha, min_cosine
        self.voxel = 2.0 * ball.radius * voxel
        self.views = 0
        self._gaps = None if ground is None else Gaps(ball, ground, band * self.voxel)
        # The surface of the ball, three blocks deep: the hash map grows by itself beyond that.
        blocks = int(3 * 4 * np.pi * (ball.radius / (_BLOCK * self.voxel)) ** 2) + 1000
        f32, one = o3d.core.float32, o3d.core.SizeVector([1])
        self._grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight"), (f32, f32), (one, one), self.voxel, _BLOCK, blocks
        )

    def integrate(self, view: SurfaceMap) -> float:
        """Fuse one view's depth; gives the share of its surface pixels that were used."""
        import open3d as o3d

        depth = usable_depth(
            view,
            self.ball,
            self.voxel,
            min_alpha=self.min_alpha,
            min_cosine=self.min_cosine,
        )
        if self._gaps is not None:
            self._gaps.add(view, depth, self.min_alpha)
        used = int((depth > 0).sum())
        if not used:
            return 0.0
        # open3d takes the pixel that floor(u), floor(v) falls in: our half-pixel centres as they
        # are (measured: shifting K by half a pixel moves a fused sphere by a quarter voxel). It
        # wants float64 matrices.
        image = o3d.t.geometry.Image(o3d.core.Tensor.from_numpy(depth[..., None]))
        K = o3d.core.Tensor.from_numpy(view.camera.K.astype(np.float64))
        pose = o3d.core.Tensor.from_numpy(view.camera.cam_from_world.astype(np.float64))
        limits = (1.0, float(depth.max()) * 2.0, self.band)
        try:
            blocks = self._grid.compute_unique_block_coordinates(image, K, pose, *limits)
        except RuntimeError as error:  # it samples every fourth pixel and may meet none of a few
            if "No block is touched" not in str(error):
                raise
            return 0.0
        self._grid.integrate(blocks, image, K, pose, *limits)
        self.views += 1
        return used / max(1, int((view.depth > 0).sum()))

    def extract(self, *, min_views: int = 1) -> RawMesh:
        """The zero crossing of the grid, where at least `min_views` views agree.

        Raises:
            MeshError: nothing was fused, or no place was seen by enough views.
        """
        if not self.views:
            raise MeshError(
                "no view shows a surface inside the object ball: nothing to fuse. Look at the "
                "renders of the trained field; if they are empty, train longer or check the masks"
            )
        mesh = self._crossing(min_views)
        if not len(mesh.faces):
            raise MeshError(
                f"{self.views} views were fused but no surface is seen by {min_views} of them: "
                "lower extract.min_views or make extract.voxel larger"
            )
        rim = mesh.vertices[rim_of(mesh).vertices].astype(np.float64)
        if self._gaps is not None and len(rim):
            self._close(self._gaps, rim, min_views)
            closed = self._crossing(min_views)
            mesh = only_bridges(closed, mesh, self._gaps.ground, 2 * self.ball.radius)
        return mesh

    def _crossing(self, min_views: int) -> RawMesh:
        """The zero crossing of the grid; without faces if there is none."""
        try:
            mesh = self._grid.extract_triangle_mesh(weight_threshold=min_views - 0.5)
            vertices = mesh.vertex.positions.numpy().astype(np.float32)
            faces = mesh.triangle.indices.numpy().astype(np.int32)
        except (RuntimeError, KeyError):  # open3d's way to say that there is no crossing
            vertices, faces = np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)
        return RawMesh(*_ordered(vertices, faces))

    def _close(self, gaps: Gaps, rim: F64, min_views: int) -> None:
        """Give the places near rims (N, 3) that too few views see what the gaps say of them."""
        import open3d as o3d

        keys = o3d.core.Tensor.from_numpy(gaps.blocks(rim, _BLOCK * self.voxel))
        table = self._grid.hashmap()
        table.activate(keys)
        values, weights = (
            self._grid.attribute(name).numpy().reshape(-1) for name in ("tsdf", "weight")
        )
        points, row = self._places(table.find(keys)[0])
        chosen = weights[row] < min_views - 0.5
        chosen[chosen] = gaps.among(points[chosen], rim)
        values[row[chosen]] = _distances(gaps.distances, points, chosen)
        weights[row[chosen]] = min_views
        active = table.active_buf_indices()
        edge = _BLOCK * self.voxel
        middles = (table.key_tensor()[active.to(o3d.core.int64)].numpy() + 0.5) * edge
        low = gaps.depths(middles, edge * 3**0.5 / 2) > -1
        points, row = self._places(o3d.core.Tensor.from_numpy(active.numpy()[low]))
        values[row] = np.maximum(values[row], gaps.depths(points))

    def _places(self, blocks: Any) -> tuple[F64, NDArray[np.int64]]:
        """(N, 3) the voxels of blocks in the world, and their rows (N,) in the grid's arrays."""
        places, rows = self._grid.voxel_coordinates_and_flattened_indices(blocks)
        return places.numpy().astype(np.float64), rows.numpy()


def _distances(distances: Callable[[F64], F32], points: F64, chosen: Bools) -> F32:
    """(K,) signed distances, in bands, of the K chosen voxels of some blocks.

    Of each block, every other voxel along each axis is looked at first. If these all are a band
    or more on one side of the surface, the whole block is taken to be. No voxel is two voxels or
    more from one that was looked at, and a band is at least as wide: the surface is elsewhere.

    Args:
        distances: of points (N, 3), world; (N,) clipped to -1 (solid) and 1 (empty).
        points: (B * _BLOCK**3, 3) all voxels of B blocks, block after block.
        chosen: (B * _BLOCK**3,) those that are wanted.
    """
    cube = np.stack(np.meshgrid(*[np.arange(_BLOCK)] * 3, indexing="ij"), -1).reshape(-1, 3)
    few = (cube % 2 == 0).all(1)
    voxels, wanted = points.reshape(-1, len(cube), 3), chosen.reshape(-1, len(cube))
    blocks = np.flatnonzero(wanted.any(1))
    first = distances(voxels[blocks][:, few].reshape(-1, 3)).reshape(len(blocks), -1)
    out = np.zeros(wanted.shape, np.float32)
    out[blocks] = first[:, :1]
    mixed = blocks[~((first >= 1).all(1) | (first <= -1).all(1))]
    fine = np.zeros_like(wanted)
    fine[mixed] = wanted[mixed]
    out[fine] = distances(voxels[fine])
    return out[wanted]


def _ordered(vertices: F32, faces: NDArray[np.int32]) -> tuple[F32, NDArray[np.int32]]:
    """The same mesh in an order that its shape alone decides; threads decide open3d's."""
    order = np.lexsort(vertices.T)
    rank = np.empty(len(order), np.int32)
    rank[order] = np.arange(len(order), dtype=np.int32)
    faces = rank[faces]
    first = faces.argmin(1)[:, None]
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, 1)  # same way round
    return vertices[order], faces[np.lexsort(faces.T)]


def usable_depth(
    view: SurfaceMap, ball: Ball, voxel: float, *, min_alpha: float, min_cosine: float
) -> F32:
    """(H, W) depth with every doubtful pixel set to 0.

    Doubtful is: thin coverage, outside the ball, seen at a grazing angle, or beside a jump in
    depth of more than two voxels (`voxel` is in world units).
    """
    depth = np.where(np.isfinite(view.depth) & (view.alpha >= min_alpha), view.depth, 0)
    depth = np.maximum(depth, 0).astype(np.float32)
    rays = view.camera.pixel_rays().astype(np.float32)
    world = rays @ view.camera.world_from_cam[:3, :3].T.astype(np.float32)
    points = view.camera.center.astype(np.float32) + world * depth[..., None]
    inside = ((points - ball.center.astype(np.float32)) ** 2).sum(-1) < ball.radius**2
    cosine = -(world * view.normal).sum(-1) / np.linalg.norm(world, axis=-1)
    smooth = without_jumps(depth, view.normal, view.camera, 2 * voxel)
    return np.where(inside & (cosine >= min_cosine) & smooth, depth, 0).astype(np.float32)
