"""A mesh that lies a little off the surface is moved onto it by what the views see against it."""

import numpy as np
import pytest
from scenes import Scene, Sphere, constant, gradient_sky, orbit
from solids import sphere

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.surface.registration import fit_views
from refdgs_pipe.surface.silhouettes import Outline

GREY = constant(0.5, 0.5, 0.5)
CAMERAS = orbit(40, size=200, focal=250)  # a pixel is 0.016 at the object


def outlines(scene: Scene) -> list[Outline]:
    return [Outline.of(camera, scene.surface_map(camera).alpha > 0.5) for camera in CAMERAS]


def fit_outlines(
    mesh: TriangleMesh, seen: list[Outline], *, limit: float, rounds: int
) -> TriangleMesh:
    return fit_views(mesh, seen, [], limit=limit, rounds=rounds).mesh


@pytest.mark.parametrize("radius", [0.96, 1.03])
def test_a_ball_too_small_or_too_large_gets_its_size(radius: float) -> None:
    wrong = sphere(32, radius=radius)
    mesh = fit_outlines(
        wrong, outlines(Scene((Sphere((0, 0, 0), 1.0, GREY),), gradient_sky)), limit=0.1, rounds=3
    )
    lengths = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(lengths.mean() - 1) < 0.004  # a quarter of a pixel
    assert lengths.std() < 0.006
    np.testing.assert_array_equal(mesh.faces, wrong.faces)


def test_an_outline_further_away_than_the_limit_is_another_parts() -> None:
    ball = sphere(24, radius=0.8)
    scene = Scene((Sphere((0, 0, 0), 1.0, GREY),), gradient_sky)
    kept = fit_outlines(ball, outlines(scene), limit=0.05, rounds=2)
    np.testing.assert_allclose(kept.vertices, ball.vertices, atol=1e-4)


def test_a_right_mesh_stays_where_it_is() -> None:
    ball = sphere(48)
    scene = Scene((Sphere((0, 0, 0), 1.0, GREY),), gradient_sky)
    kept = fit_outlines(ball, outlines(scene), limit=0.1, rounds=2)
    assert np.abs(kept.vertices - ball.vertices).max() < 0.006
