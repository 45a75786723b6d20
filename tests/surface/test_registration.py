"""Views that disagree on colours, and frayed rims, move a mesh to where the surface is."""

import numpy as np
import pytest
from scenes import Scene, Sphere, constant, gradient_sky, orbit, waves
from solids import sphere

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.surface.agreement import Pattern
from refdgs_pipe.surface.registration import fit_views
from refdgs_pipe.surface.rims import fit_rims, rim_of
from refdgs_pipe.surface.silhouettes import Outline

CAMERAS = orbit(24, size=200, focal=250)  # a pixel is 0.016 at the object
PATTERNED = Scene((Sphere((0, 0, 0), 1.0, waves),), gradient_sky)


def patterns(scene: Scene) -> list[Pattern]:
    return [Pattern(scene.surface_map(camera), near=0.1) for camera in CAMERAS]


def plate(frayed: float) -> TriangleMesh:
    """A flat disc of radius one with a rim that is off by random lengths."""
    rings, around = 12, 90
    radius = np.linspace(0, 1, rings + 1)[1:, None] * np.ones(around)
    radius[-1] += np.random.default_rng(0).uniform(-frayed, frayed, around)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * radius], -1)
    inner = 1 + np.arange((rings - 1) * around).reshape(rings - 1, around)
    a, b, c, d = inner, np.roll(inner, -1, 1), inner + around, np.roll(inner, -1, 1) + around
    quads = np.concatenate([np.stack([a, c, d], -1), np.stack([a, d, b], -1)]).reshape(-1, 3)
    middle = np.stack([0 * inner[0], inner[0], np.roll(inner[0], -1)], -1)
    vertices = np.concatenate([np.zeros((1, 3)), points.reshape(-1, 3)])
    return TriangleMesh(
        vertices.astype(np.float32), np.concatenate([middle, quads]).astype(np.int32)
    )


def outlines_of_a_disc() -> list[Outline]:
    found = []
    for camera in CAMERAS:
        if camera.center[2] < 0.5:
            continue
        rays = camera.pixel_rays() @ camera.cam_from_world[:3, :3]
        met = camera.center - rays * (camera.center[2] / rays[..., 2:])
        covered = (np.linalg.norm(met[..., :2], axis=-1) < 1) & (rays[..., 2] < 0)
        found.append(Outline.of(camera, covered))
    return found


@pytest.mark.parametrize("radius", [0.985, 1.015])
def test_views_that_disagree_on_a_pattern_move_the_mesh(radius: float) -> None:
    wrong = sphere(48, radius=radius)
    mesh = fit_views(wrong, [], patterns(PATTERNED), limit=0.1, rounds=3).mesh
    lengths = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(np.median(lengths) - 1) < 0.003
    assert np.quantile(np.abs(lengths - 1), 0.9) < 0.008


def test_what_has_no_pattern_stays() -> None:
    grey = Scene((Sphere((0, 0, 0), 1.0, constant(0.5, 0.5, 0.5)),), gradient_sky)
    wrong = sphere(24, radius=0.98)
    mesh = fit_views(wrong, [], patterns(grey), limit=0.1, rounds=2).mesh
    assert np.abs(mesh.vertices - wrong.vertices).max() < 0.003


def test_a_frayed_rim_ends_where_the_views_see_it_end() -> None:
    wrong = plate(0.03)
    before = np.linalg.norm(wrong.vertices[rim_of(wrong).vertices], axis=1)
    mesh = wrong
    for _ in range(3):
        mesh = fit_rims(mesh, outlines_of_a_disc(), limit=0.1)
    rim = mesh.vertices[rim_of(mesh).vertices]
    after = np.linalg.norm(rim, axis=1)
    assert before.std() > 0.01
    assert abs(after.mean() - 1) < 0.006 and after.std() < 0.004
    assert np.abs(rim[:, 2]).max() < 1e-4
    inner = np.linalg.norm(wrong.vertices, axis=1) < 0.5
    assert np.abs(mesh.vertices[inner] - wrong.vertices[inner]).max() < 0.004


def test_a_closed_mesh_has_no_rim() -> None:
    ball = sphere(16)
    assert fit_rims(ball, outlines_of_a_disc(), limit=0.1) is ball
