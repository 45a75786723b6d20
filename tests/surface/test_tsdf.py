"""Fused depth lies where the surface is, to a small part of a voxel."""

from dataclasses import replace

import numpy as np
import pytest
import truth
from scenes import Box, Scene, Sphere, glossy_pair, gradient_sky, orbit, waves

from refdgs_pipe.artifacts.mesh import RawMesh
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.errors import MeshError
from refdgs_pipe.surface.tsdf import Volume, usable_depth

BALL = Ball(np.zeros(3), 1.2)


def fuse(scene: Scene, *, voxel: float = 0.01, views: int = 30, min_views: int = 2) -> RawMesh:
    volume = Volume(BALL, voxel=voxel)
    for camera in orbit(views):
        volume.integrate(scene.surface_map(camera))
    return volume.extract(min_views=min_views)


def test_a_fused_sphere_is_unbiased_and_faces_outwards() -> None:
    # A half-pixel mistake shows as a shift of the centre by 0.2 voxels or more.
    center = np.array([0.03, 0.02, -0.01])
    mesh = fuse(Scene((Sphere(tuple(center), 0.9, waves),), gradient_sky))
    voxel = 0.024
    offset = mesh.vertices - center
    radii = np.linalg.norm(offset, axis=1)
    assert abs(radii.mean() - 0.9) < 0.05 * voxel
    assert np.abs(radii - 0.9).mean() < 0.12 * voxel
    corners = offset[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners[:, 0]).sum(1) > 0).mean() > 0.999
    areas = np.linalg.norm(normals, axis=1)
    centroid = (corners.mean(1) * areas[:, None]).sum(0) / areas.sum()
    assert np.abs(centroid).max() < 0.1 * voxel


def test_planes_of_a_box_have_no_bias() -> None:
    scene = Scene((Box((-0.5, -0.45, -0.4), (0.5, 0.55, 0.45), waves),), gradient_sky)
    vertices = fuse(scene).vertices.astype(float)
    for axis, value in ((0, -0.5), (0, 0.5), (1, -0.45), (1, 0.55), (2, -0.4), (2, 0.45)):
        on_face = np.abs(vertices[:, axis] - value) < 0.02
        on_face &= (np.abs(np.delete(vertices, axis, 1)) < 0.35).all(1)
        assert on_face.sum() > 100
        assert abs((vertices[on_face, axis] - value).mean()) < 0.05 * 0.024


def test_what_lies_outside_the_ball_is_not_fused() -> None:
    outside = Sphere((0.0, 0.0, 1.7), 0.3, waves)
    mesh = fuse(Scene((*glossy_pair().solids, outside), gradient_sky))
    assert np.linalg.norm(mesh.vertices, axis=1).max() < 1.2 + 4 * 0.024


def test_doubtful_pixels_are_dropped() -> None:
    view = glossy_pair().surface_map(orbit(1, size=120)[0])
    limits = {"min_alpha": 0.5, "min_cosine": 0.15}

    def used(**changes: np.ndarray) -> int:
        changed = replace(view, **changes)
        return int((usable_depth(changed, BALL, 0.02, **limits) > 0).sum())

    assert 0 < used() <= (view.depth > 0).sum()
    assert used(alpha=view.alpha * np.float32(0.4)) == 0
    assert used(depth=view.depth * np.float32(np.nan)) == 0
    assert used(depth=view.depth * np.float32(3)) == 0
    row, column = np.argwhere(usable_depth(view, BALL, 0.02, **limits) > 0).mean(0).astype(int)
    depth = view.depth.copy()
    depth[row, column] += 0.3
    assert used() - 9 <= used(depth=depth) < used()


def test_a_view_of_a_few_pixels_is_passed_over() -> None:
    view = Scene((Sphere((0.0, 0.0, 0.0), 0.9, waves),), gradient_sky).surface_map(orbit(3)[1])
    rows, columns = np.indices(view.depth.shape)
    middle = tuple(side // 2 for side in view.depth.shape)
    for drop in range(4):  # whichever pixels are sampled, most of these patches miss them
        few = (abs(rows - middle[0] - drop) <= 1) & (abs(columns - middle[1] - drop) <= 1)
        volume = Volume(BALL, voxel=0.02)
        assert 0 <= volume.integrate(replace(view, depth=view.depth * few)) <= 1


def test_nothing_to_fuse_is_said_in_words() -> None:
    volume = Volume(BALL, voxel=0.02)
    with pytest.raises(MeshError, match="no view shows a surface inside the object ball"):
        volume.extract()
    view = glossy_pair().surface_map(orbit(1)[0])
    assert volume.integrate(replace(view, depth=view.depth * 0)) == 0
    volume.integrate(view)
    with pytest.raises(MeshError, match=r"lower extract\.min_views"):
        volume.extract(min_views=5)


@truth.needs_scenes
@pytest.mark.parametrize("name", ["spheres", "kettle", "mug"])
def test_true_depth_gives_the_true_surface(name: str) -> None:
    # Measured: mean distance 0.06 to 0.1 voxels. The few vertices further off lie on rims that
    # 16 views see from one side only.
    volume = Volume(truth.ball(name), voxel=0.004)
    for view in truth.surface_maps(name):
        volume.integrate(view)
    found = truth.distances(volume.extract(min_views=2).vertices, *truth.mesh(name))
    assert found.mean() < 0.15 * volume.voxel
    assert np.quantile(found, 0.99) < volume.voxel
