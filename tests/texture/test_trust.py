"""Confidence is low where a mesh is off the true surface, and where nothing tells its shape."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import Scene, Sphere, gradient_sky, orbit, waves
from solids import sphere

from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.photos import Photo
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import MeshError
from refdgs_pipe.texture.trust import HALF, ShapeErrors, expected_errors

SCENE = Scene((Sphere((0, 0, 0), 1.0, waves, roughness=0.9),), gradient_sky)
CAMERAS = orbit(20, size=200, focal=300)
DENT = np.array([1.0, 0, 0.3]) / np.hypot(1, 0.3)


def dented(depth: float) -> UvMesh:
    """The unit sphere with a dent towards DENT, half a radian wide."""
    mesh = sphere(60)
    angle = np.arccos(np.clip(mesh.vertices @ DENT, -1, 1))
    inward = np.maximum(0, 1 - (angle / 0.5) ** 2)
    points = (mesh.vertices * (1 - depth * inward)[:, None]).astype(np.float32)
    bent = replace(mesh, vertices=points)
    return UvMesh(points, bent.vertex_normals(), np.zeros((len(points), 2), np.float32), mesh.faces)


def errors(mesh: UvMesh, *, cameras: list[Camera] = CAMERAS, masks: bool = True) -> ShapeErrors:
    """What photos and a perfect field of the true sphere say of a mesh."""
    views = {camera.name: SCENE.surface_map(camera) for camera in cameras}

    def load(camera: Camera, *, scale: float) -> Photo:
        assert scale == 1
        shown = views[camera.name]
        valid = np.ones(shown.alpha.shape, bool)
        return Photo(camera, shown.color, shown.alpha if masks else None, valid)

    def draw(camera: Camera) -> SurfaceMap:
        return views[camera.name]

    return expected_errors(mesh, cameras, load, draw, lambda items, _: items)


@pytest.mark.parametrize(("masks", "times"), [(True, 2), (False, 1.5)])
def test_a_dent_is_less_certain_than_what_lies_round_it(masks: bool, times: float) -> None:
    found = errors(dented(0.1), masks=masks)
    angle = np.arccos(np.clip(found.points @ DENT / np.linalg.norm(found.points, axis=1), -1, 1))
    inside, outside = found.percent[angle < 0.3], found.percent[angle > 0.6]
    assert np.median(inside) > times * np.median(outside)


def test_the_true_surface_is_more_certain_than_a_dented_one() -> None:
    true, wrong = (errors(dented(depth)) for depth in (0.0, 0.1))
    assert true.percent.mean() < 0.8 * wrong.percent.mean()
    assert np.quantile(true.percent, 0.9) < HALF


def test_what_no_camera_sees_is_a_guess() -> None:
    above = [camera for camera in CAMERAS if camera.center[2] > 0.3]
    found = errors(dented(0.0), cameras=above)
    confidence = found.confidence(np.array([[0, 0, 1], [0, 0, -1]], np.float32))
    assert confidence[0] > 0.7 and confidence[1] < 0.2


def test_a_mesh_without_area_is_refused() -> None:
    flat = dented(0.0)
    with pytest.raises(MeshError, match="no area"):
        errors(replace(flat, vertices=flat.vertices * np.float32([1, 0, 0])))


def test_confidence_is_one_half_at_the_distance_that_says_so() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    found = ShapeErrors(points, np.float32([0, HALF, 10 * HALF, 1]))
    np.testing.assert_allclose(
        found.confidence(points[:3].astype(np.float32)), [1, 0.5, 1 / 101], atol=1e-4
    )


def test_the_order_of_the_views_changes_nothing() -> None:
    one, other = errors(dented(0.1)), errors(dented(0.1), cameras=CAMERAS[::-1])
    np.testing.assert_array_equal(one.points, other.points)
    np.testing.assert_allclose(one.percent, other.percent, rtol=1e-4)
