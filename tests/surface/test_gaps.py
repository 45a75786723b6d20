"""What no view sees is closed near torn rims, and only where no view looks through."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import Box, Scene, Sphere, gradient_sky, look_at, waves
from solids import volume

from refdgs_pipe.artifacts.mesh import RawMesh, TriangleMesh
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import Camera
from refdgs_pipe.surface.cleanup import clean
from refdgs_pipe.surface.gaps import without_base
from refdgs_pipe.surface.rims import rim_of
from refdgs_pipe.surface.tsdf import Volume, _distances

BALL = Ball(np.array([0.0, 0.0, 0.5]), 1.0)
DIAMETER, VOXEL, UP = 2.0, 0.02, np.array([0.0, 0.0, 1.0])
BODY, FOOT = 0.5, 0.44  # half the widths
LIFT = 0.1
STANDING = Scene(
    (
        Box((-BODY, -BODY, LIFT), (BODY, BODY, 0.7), waves),
        Box((-FOOT, -FOOT, 0.0), (FOOT, FOOT, LIFT), waves),
    ),
    gradient_sky,
)


def around(*heights: float, count: int = 16) -> list[Camera]:
    """Cameras in rings round the world's z axis, at heights in degrees."""
    out = []
    for height in np.radians(heights):
        for turn in np.linspace(0, 2 * np.pi, count, endpoint=False) + height:
            flat = np.cos(height)
            eye = 4 * np.array([flat * np.cos(turn), flat * np.sin(turn), np.sin(height)])
            out.append(look_at(f"v{len(out):03d}", eye))
    return out


@cache
def fused(scene: Scene, *heights: float, close: bool = True) -> RawMesh:
    grid = Volume(BALL, voxel=VOXEL / DIAMETER, ground=UP if close else None)
    for camera in around(*heights):
        grid.integrate(scene.surface_map(camera))
    return grid.extract(min_views=2)


def rim_heights(mesh: TriangleMesh) -> NDArray[np.floating]:
    return np.asarray(mesh.vertices[rim_of(mesh).vertices, 2])


def test_a_body_is_joined_to_its_foot_and_ends_on_the_ground() -> None:
    torn = without_base(fused(STANDING, 15, 40, close=False), UP, DIAMETER)
    assert rim_heights(torn).max() > 0.05  # no view sees the body from below
    closed = without_base(fused(STANDING, 15, 40), UP, DIAMETER)
    assert np.abs(rim_heights(closed)).max() < 1e-6  # one clean edge, on the ground
    # What was seen stays. What is added lies between the foot and the body, where it hides.
    across = np.abs(closed.vertices[:, :2]).max(1)
    height = closed.vertices[:, 2]
    assert np.abs(across[(height > 0.25) & (height < 0.6)] - BODY).max() < 0.6 * VOXEL
    low = across[height < 0.05]
    assert low.min() > FOOT - 1.5 * VOXEL and low.max() < FOOT + 1.5 * VOXEL


def test_a_belly_whose_underside_no_view_sees_ends_on_the_ground() -> None:
    belly = Scene((Sphere((0.0, 0.0, BODY), BODY, waves),), gradient_sky)
    torn = without_base(fused(belly, 20, 40, close=False), UP, DIAMETER)
    assert rim_heights(torn).min() > 0.02 * DIAMETER
    closed = without_base(fused(belly, 20, 40), UP, DIAMETER)
    assert np.abs(rim_heights(closed)).max() < VOXEL / 4
    low = closed.vertices[closed.vertices[:, 2] < 0.01, :2]
    # No view looks under it: its outlines at 20 degrees meet the ground at this radius.
    assert np.linalg.norm(low, axis=1).max() < BODY * np.tan(np.radians(10)) + 3 * VOXEL


def test_voxels_far_from_the_surface_need_no_look_of_their_own() -> None:
    cube = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3)
    corners = np.stack(np.meshgrid(*[np.arange(-3, 3) * 8] * 3, indexing="ij"), -1).reshape(-1, 3)
    points = (corners[:, None] + cube).reshape(-1, 3).astype(np.float64)
    chosen = np.random.default_rng(0).random(len(points)) < 0.7
    looked_at = []

    def ball(places: NDArray[np.float64]) -> NDArray[np.float32]:
        looked_at.append(len(places))
        outside = (np.linalg.norm(places, axis=1) - 13) / 4
        return np.asarray(np.clip(outside, -1, 1), np.float32)

    found = _distances(ball, points, chosen)
    assert sum(looked_at) < 0.8 * chosen.sum()
    true = ball(points[chosen])
    near = (
        np.abs(true) < 0.5
    )  # the surface lies between such voxels; elsewhere only the sign counts
    np.testing.assert_array_equal(found[near], true[near])
    np.testing.assert_array_equal(np.sign(found), np.sign(true))


def test_a_closed_base_makes_the_mesh_watertight() -> None:
    raw = fused(STANDING, 15, 40)
    settings = {"floater": 0.1, "hole": 0.1, "smoothing": 0, "faces": 10**6}
    open_below = clean(without_base(raw, UP, DIAMETER), **settings)  # type: ignore[arg-type]
    closed = clean(raw, **settings, base=UP)  # type: ignore[arg-type]
    assert len(open_below.rims) == 1 and closed.rims == []
    assert volume(closed.mesh) == pytest.approx(4 * (BODY**2 * 0.6 + FOOT**2 * LIFT), rel=0.05)


@pytest.mark.parametrize("gap", [0.08, 0.16])
def test_views_that_look_through_keep_a_gap_open(gap: float) -> None:
    hovering = Scene((Sphere((0.0, 0.0, 0.5 + gap), 0.5, waves),), gradient_sky)
    mesh = fused(hovering, 2, 15, 40)
    low = mesh.vertices[mesh.vertices[:, 2] < gap / 2]
    assert len(low) == 0
    assert mesh.vertices[:, 2].min() > 0.6 * gap


def test_nothing_hangs_below_a_body_that_does_not_reach_the_ground() -> None:
    shade = Scene((Box((-BODY, -BODY, 0.45), (BODY, BODY, 0.8), waves),), gradient_sky)
    mesh, torn = fused(shade, 15, 40), fused(shade, 15, 40, close=False)
    assert rim_heights(torn).max() < 0.5  # open below
    inside = np.abs(mesh.vertices[:, :2]).max(1) < BODY - 3 * VOXEL
    assert mesh.vertices[inside, 2].min() > 0.75
    assert len(mesh.faces) == pytest.approx(len(torn.faces), rel=0.06)


def test_one_view_alone_does_not_make_a_place_empty() -> None:
    grid = Volume(BALL, voxel=VOXEL / DIAMETER, ground=UP)
    views = [STANDING.surface_map(camera) for camera in around(15, 40)]
    for view in views:
        grid.integrate(view)
    views[3].alpha[:] = 0
    grid.integrate(views[3])
    mesh = without_base(grid.extract(min_views=2), UP, DIAMETER)
    assert np.abs(rim_heights(mesh)).max() < 1e-6
