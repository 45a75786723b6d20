"""Baked textures are the colours, normals and roughness of the true surface."""

from dataclasses import replace

import numpy as np
import pytest
from finished import appearance
from scenes import Scene, Sphere, constant, gradient_sky, orbit, waves
from solids import sphere

from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.color import linear_from_srgb
from refdgs_pipe.errors import MeshError
from refdgs_pipe.texture.baking import Gather
from refdgs_pipe.texture.charts import seam_split, unmirrored
from refdgs_pipe.texture.material import Painter
from refdgs_pipe.texture.tangents import mikktspace, tangent_space
from refdgs_pipe.texture.texels import coverage, rasterize
from refdgs_pipe.texture.trust import HALF, ShapeErrors

SCENE = Scene((Sphere((0, 0, 0), 1.0, waves, roughness=0.3),), gradient_sky)


def ball(rings: int = 40) -> UvMesh:
    """The unit sphere with an atlas of its own: two discs, north and south."""
    mesh = sphere(rings)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    south = corners.mean(1)[:, 2] < 0
    radius = np.arccos(np.clip(np.abs(corners[..., 2]), 0, 1)) / np.pi * 2
    flat = corners[..., :2] / np.maximum(np.linalg.norm(corners[..., :2], axis=-1), 1e-9)[..., None]
    uv = flat * radius[..., None] * 0.23
    uv[south, :, 0] *= -1
    uv += np.where(south, 0.75, 0.25)[:, None, None] * [1, 0] + [0, 0.5]
    return seam_split(mesh, unmirrored(uv.astype(np.float32)))


def paint(views: list[SurfaceMap], *, size: int = 256) -> tuple[Painter, TexturedMesh]:
    painter = Painter(ball(), size, tolerance=0.03)
    for view in views:
        painter.add(view)
    return painter, painter.paint(appearance(ball().vertices))


def texel_points(mesh: UvMesh, size: int) -> tuple[np.ndarray, np.ndarray]:
    texels = rasterize(mesh, size)
    points = texels.interpolate(mesh, mesh.vertices).astype(float)
    return texels.index, points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def views() -> list[SurfaceMap]:
    return [SCENE.surface_map(camera) for camera in orbit(24, size=200, focal=300)]


def test_colours_are_the_scenes_and_materials_the_vertices(
    views: list[SurfaceMap],
) -> None:
    painter, textured = paint(views)
    index, points = texel_points(textured.mesh, 256)
    base = linear_from_srgb(textured.base_color.reshape(-1, 3)[index] / np.float32(65535))
    error = np.abs(base - waves(points)).mean(1)
    assert painter.seen_share > 0.999
    assert error.mean() < 0.005 and np.quantile(error, 0.99) < 0.02
    rough = textured.roughness.reshape(-1)[index] / 65535
    assert np.abs(rough - 0.3).max() < 0.02
    assert textured.metallic.max() == 0
    assert (textured.confidence.reshape(-1)[index] > 0.8 * 65535).mean() > 0.98


def test_the_normal_map_restores_the_true_normals(views: list[SurfaceMap]) -> None:
    # The mesh is coarse (3.6 degree facets smoothed by vertex normals); the maps are exact.
    painter = Painter(ball(12), 256, tolerance=0.05)
    for view in views:
        painter.add(view)
    textured = painter.paint(appearance(ball(12).vertices))
    mesh = textured.mesh
    texels = rasterize(mesh, 256)
    local = textured.normal.reshape(-1, 3)[texels.index] / 65535 * 2 - 1
    tangent = texels.interpolate(mesh, textured.tangents[:, :3])
    plain = texels.interpolate(mesh, mesh.normals)
    across = np.cross(plain, tangent) * textured.tangents[mesh.faces[texels.face, 0], 3:]
    normal = local[:, :1] * tangent + local[:, 1:2] * across + local[:, 2:] * plain
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    points = texels.interpolate(mesh, mesh.vertices)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((normal * points).sum(1), -1, 1)))
    assert angle.mean() < 0.6 and np.quantile(angle, 0.99) < 2.5


def test_base_colours_are_what_is_scattered_of_the_light_received(
    views: list[SurfaceMap],
) -> None:
    painter = Painter(ball(), 128, tolerance=0.03)
    for view in views:
        painter.add(view)
    _, lit = paint(views, size=128)
    dim = painter.paint(appearance(ball().vertices, received=2.0))
    bright, dark = (linear_from_srgb(t.base_color / np.float32(65535)) for t in (lit, dim))
    np.testing.assert_allclose(dark, bright / 2, atol=2e-3)


def test_metal_has_its_reflectance_as_base_colour(views: list[SurfaceMap]) -> None:
    painter = Painter(ball(), 128, tolerance=0.03)
    for view in views:
        painter.add(view)
    looks = appearance(ball().vertices)
    gold = np.broadcast_to(np.float32([1.0, 0.7, 0.3]), looks.tint.shape)
    textured = painter.paint(replace(looks, metallic=looks.openness, tint=gold))
    base = linear_from_srgb(textured.base_color / np.float32(65535))
    np.testing.assert_allclose(base, np.broadcast_to(gold[0], base.shape), atol=1e-4)
    assert textured.metallic.min() == 65535


def test_one_view_with_a_wrong_colour_is_outvoted(views: list[SurfaceMap]) -> None:
    red = replace(views[3], diffuse=np.zeros_like(views[3].diffuse) + np.float32([5, 0, 0]))
    _, textured = paint([*views[:3], red, *views[4:]])
    index, points = texel_points(textured.mesh, 256)
    base = linear_from_srgb(textured.base_color.reshape(-1, 3)[index] / np.float32(65535))
    assert np.quantile(np.abs(base - waves(points)).max(1), 0.98) < 0.1


def test_confidence_is_that_of_the_expected_errors_where_a_view_sees_the_texel(
    views: list[SurfaceMap],
) -> None:
    painter = Painter(ball(), 256, tolerance=0.03)
    for view in views[:6]:  # all from above
        painter.add(view)
    points = ball().vertices.astype(float)
    errors = ShapeErrors(points, np.full(len(points), HALF, np.float32))
    textured = painter.paint(appearance(ball().vertices), errors)
    index, points = texel_points(textured.mesh, 256)
    confidence = textured.confidence.reshape(-1)[index] / 65535
    np.testing.assert_allclose(confidence[points[:, 2] > 0.95], 0.5, atol=1e-4)
    assert (confidence[points[:, 2] < -0.95] == 0).all()


def test_what_no_view_sees_is_filled_from_beside_it_with_no_confidence(
    views: list[SurfaceMap],
) -> None:
    painter, textured = paint(views[:6])  # all from above
    index, points = texel_points(textured.mesh, 256)
    assert 0.3 < painter.seen_share < 0.95
    below = points[:, 2] < -0.95
    assert (textured.confidence.reshape(-1)[index][below] == 0).all()
    assert (textured.base_color.reshape(-1, 3)[index][below] > 0).all()
    normal = textured.normal.reshape(-1, 3)[index][below] / 65535 * 2 - 1
    assert (normal[:, 2] > 0.99).all()


@pytest.mark.parametrize("moved", [0.1, -0.1])
def test_a_part_off_the_mesh_tells_colours_but_no_normals(
    views: list[SurfaceMap], moved: float
) -> None:
    points, normals = np.array([[0, 0, 1.0]], np.float32), np.array([[0, 0, 1.0]], np.float32)

    def gathered(depth: float) -> Gather:
        gather = Gather(points, normals, tolerance=0.03)
        for view in views:
            aslant = view.normal + np.array([0.5, 0, 0], np.float32)
            aslant /= np.linalg.norm(aslant, axis=-1, keepdims=True)
            gather.add(replace(view, depth=view.depth + np.float32(depth), normal=aslant))
        return gather

    near, off = gathered(0.0).surface(), gathered(moved).surface()
    assert off.seen.all()
    np.testing.assert_allclose(off.diffuse, near.diffuse, atol=0.02)
    np.testing.assert_allclose(off.normal, normals)
    assert near.normal[0, 2] < 0.95
    for depth in (0.3, -0.3):  # too far behind or before the mesh
        with pytest.raises(MeshError):
            gathered(depth).surface()


def test_occluded_points_take_nothing_from_what_hides_them() -> None:
    wall = Sphere((0.0, 0.0, 1.45), 0.3, constant(1, 0, 0))
    scene = Scene((*SCENE.solids, wall), gradient_sky)
    _, textured = paint([scene.surface_map(c) for c in orbit(40, size=200, focal=300)])
    index, points = texel_points(textured.mesh, 256)
    base = linear_from_srgb(textured.base_color.reshape(-1, 3)[index] / np.float32(65535))
    assert np.quantile(np.abs(base - waves(points)).max(1), 0.97) < 0.08


def test_no_view_at_all_is_an_error(views: list[SurfaceMap]) -> None:
    far = np.array([[50.0, 0, 0]], np.float32)
    gather = Gather(far, np.array([[0, 0, 1]], np.float32), tolerance=0.01)
    assert gather.add(views[0]) == 0
    with pytest.raises(MeshError, match="no view shows any part of the mesh"):
        gather.surface()


def test_between_charts_the_nearest_texel_is_repeated() -> None:
    mesh = ball()
    texels = rasterize(mesh, 64)
    picture = texels.picture(np.arange(len(texels.index)))
    np.testing.assert_array_equal(picture.reshape(-1)[texels.index], np.arange(len(texels.index)))
    covered = np.zeros(64 * 64, bool)
    covered[texels.index] = True
    empty = np.argwhere(~covered.reshape(64, 64))
    own = np.argwhere(covered.reshape(64, 64))
    for row, column in empty[::97]:
        gap = np.hypot(*(own - (row, column)).T)
        assert np.isclose(gap[picture[row, column]], gap.min())


def test_texels_are_those_whose_centre_a_face_covers() -> None:
    corners = np.array([[[0, 0], [1, 0], [0, 1]]], np.float32)
    covered = coverage(corners, 8)
    column, row = np.meshgrid(np.arange(8), np.arange(8))
    np.testing.assert_array_equal(covered > 0, column + row + 1 < 8)


def test_tangent_space_turns_back_to_the_same_normals() -> None:
    mesh = ball(16)
    texels, tangents = rasterize(mesh, 64), mikktspace(mesh)
    assert np.allclose(np.linalg.norm(tangents[:, :3], axis=1), 1, atol=1e-5)
    assert set(tangents[:, 3]) == {1.0}  # no chart is mirrored
    plain = texels.interpolate(mesh, mesh.normals)
    plain /= np.linalg.norm(plain, axis=1, keepdims=True)
    local = tangent_space(texels, mesh, tangents, plain)
    assert np.abs(local - [0, 0, 1]).max() < 1e-3
    # Green is up: towards smaller v, which is towards +y on the northern disc.
    north = (mesh.vertices[:, 2] > 0.3) & (mesh.uv[:, 0] < 0.5)
    up = np.cross(mesh.normals[north], tangents[north, :3])
    rise = np.array([0, 1, 0]) - mesh.normals[north] * mesh.normals[north][:, 1:2]
    sign = np.sign(((mesh.uv[north, 1] - 0.5) * mesh.vertices[north, 1]).sum())
    assert (-sign * (up * rise).sum(1) > 0).mean() > 0.95


def test_normals_that_views_disagree_on_give_way_to_the_meshs(views: list[SurfaceMap]) -> None:
    random = np.random.default_rng(0)

    def shaken(view: SurfaceMap) -> SurfaceMap:
        normal = view.normal + 0.3 * random.normal(size=view.normal.shape)
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        here = (view.depth > 0)[..., None]
        return replace(view, normal=np.where(here, normal, 0).astype(np.float32))

    _, textured = paint([shaken(view) for view in views])
    index, _ = texel_points(textured.mesh, 256)
    normal = textured.normal.reshape(-1, 3)[index] / 65535 * 2 - 1
    assert np.degrees(np.arccos(np.clip(normal[:, 2], -1, 1))).mean() < 2


def test_points_that_face_the_eye_squarely_are_seen(views: list[SurfaceMap]) -> None:
    view = views[0]
    camera = view.camera
    rays = camera.pixel_rays() @ camera.cam_from_world[:3, :3]
    here = np.zeros_like(view.depth, bool)
    here[70:130, 70:130] = True  # the middle of the ball
    points = camera.center + rays[here] * view.depth[here][:, None]
    normals = -rays[here] / np.linalg.norm(rays[here], axis=1, keepdims=True)
    gather = Gather(points.astype(np.float32), normals.astype(np.float32), tolerance=0.01)
    with np.errstate(invalid="raise"):
        assert gather.add(view) == here.sum()
