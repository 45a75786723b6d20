"""Views agree on what a surface mirrors, if its shape is right; bulges on flat mirrors go."""

from collections.abc import Callable

import numpy as np
import open3d as o3d
import pytest
from captures import looking
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.camera import Camera
from refdgs_pipe.irradiance import links_of
from refdgs_pipe.mirrored import Glimpse, Room, mirror_agreement, unexplained
from refdgs_pipe.ray_casting import Solid
from refdgs_pipe.surface.flats import Mirrored, flats_of, flattened

F64 = NDArray[np.float64]
HALF = np.array([0.5, 0.4, 0.3])
LIMIT, DIAMETER = 0.02, 2.0
UP = np.array([0.0, 0.0, 1.0])
Light = Callable[[F64, F64], F64]  # of places (N, 3) and directions (N, 3): colours (N, 3)


def bulged_box(height: float) -> TriangleMesh:
    """A box whose top bulges outwards as the solid does that cameras from above allow."""
    shape = o3d.geometry.TriangleMesh.create_box(*(2 * HALF)).subdivide_midpoint(5)
    points = np.asarray(shape.vertices) - HALF
    top = points[:, 2] > HALF[2] - 1e-6
    gap = np.minimum(HALF[0] - np.abs(points[top, 0]), HALF[1] - np.abs(points[top, 1]))
    points[top, 2] += height * (1 - (1 - gap / HALF[1]) ** 2)
    return TriangleMesh(points.astype(np.float32), np.asarray(shape.triangles, np.int32))


def on_edges(mesh: TriangleMesh) -> F64:
    gap = np.sort(HALF - np.minimum(np.abs(mesh.vertices), HALF), axis=1)
    return np.where(gap[:, 1] < 0.05, 3.0, 0.0)


def far(_: F64, away: F64) -> F64:
    """A room: stripes by direction."""
    wave = [np.sin(5 * away[:, 0]), np.sin(6 * away[:, 1] + 1), np.sin(9 * away[:, 0])]
    return 0.5 + 0.4 * np.stack(wave, -1)


def walls(places: F64, away: F64) -> F64:
    """The same room with walls on a sphere round the object, four of its sizes away."""
    return far(places, Room(np.zeros(3), 4.0 * DIAMETER / 2).met(places, away))


def plain(_: F64, away: F64) -> F64:
    return np.full_like(away, 0.4)


def ground(places: F64, away: F64) -> F64:
    """Stripes on the ground z = 0, for rays that fall; the room is plain."""
    length = np.where(away[:, 2] < 0, -places[:, 2] / np.minimum(away[:, 2], -1e-9), 0)
    at = places + length[:, None] * away
    wave = np.stack([np.sin(7 * at[:, 0]), np.sin(6 * at[:, 1]), np.cos(8 * at[:, 1])], -1)
    return np.where(away[:, 2:] < 0, 0.5 + 0.4 * wave, 0.5)


LEVELS = (12.0, 30.0, 50.0)
STEEP = (40.0, 52.0, 65.0)


def glimpses_of(
    shown: TriangleMesh,
    true: TriangleMesh,
    light: Light,
    levels: tuple[float, float, float] = LEVELS,
) -> list[Glimpse]:
    """What cameras all round see: depth of the mesh that is shown, colours of the true mirror."""
    solids = [Solid(mesh.vertices, mesh.faces) for mesh in (shown, true)]
    normals = true.vertex_normals().astype(float)
    found = []
    for number in range(24):
        azimuth, level = 2.4 * number, np.radians(levels[number % 3])
        around = np.cos(level) * np.array([np.cos(azimuth), np.sin(azimuth)])
        pose = looking(3.5 * np.array([*around, np.sin(level)]))
        K = np.array([[190.0, 0, 80], [0, 190, 60], [0, 0, 1]])
        camera = Camera(str(number), 160, 120, K, pose)
        rays = camera.pixel_rays().reshape(-1, 3) @ pose[:3, :3]
        start = camera.center.astype(np.float32)
        depth, color = np.zeros(len(rays), np.float32), np.zeros((len(rays), 3), np.float32)
        hits = solids[0].first(start, rays.astype(np.float32))
        depth[hits.rays] = hits.distance
        hits = solids[1].first(start, rays.astype(np.float32))
        at = np.einsum("nk,nkc->nc", hits.weights, normals[true.faces[hits.face]])
        at /= np.linalg.norm(at, axis=1, keepdims=True)
        toward = rays[hits.rays] / np.linalg.norm(rays[hits.rays], axis=1, keepdims=True)
        away = toward - 2 * (toward * at).sum(1, keepdims=True) * at
        place = camera.center + hits.distance[:, None] * rays[hits.rays]
        color[hits.rays] = light(place, away)
        found.append(Glimpse(camera, color.reshape(120, 160, 3), depth.reshape(120, 160)))
    return found


def upper(mesh: TriangleMesh, glimpses: list[Glimpse]) -> tuple[bool, TriangleMesh]:
    """Whether the top was made flat, and the mesh afterwards."""
    told = np.zeros(len(mesh.vertices))
    flats = flats_of(
        mesh,
        on_edges(mesh),
        told,
        limit=LIMIT,
        diameter=DIAMETER,
        mirrored=Mirrored(glimpses, np.zeros(3)),
    )
    return any(flat.normal[2] > 0.9 for flat in flats), flattened(mesh, flats)


@pytest.mark.parametrize("light", [far, walls])
def test_a_bulge_that_mirrors_as_a_plane_becomes_one(light: Light) -> None:
    mesh = bulged_box(0.06)
    is_flat, done = upper(mesh, glimpses_of(mesh, bulged_box(0), light))
    assert is_flat
    top = (np.abs(mesh.vertices[:, :2]) < HALF[:2] - 0.1).all(1) & (mesh.vertices[:, 2] > 0.2)
    assert np.abs(mesh.vertices[top, 2] - HALF[2]).max() > 0.05
    assert np.abs(done.vertices[top, 2] - HALF[2]).max() < 0.01  # half the limit


def roofed_box(slope: float) -> TriangleMesh:
    """A box with the roof that silhouettes leave on a flat top if cameras look down steeply."""
    shape = o3d.geometry.TriangleMesh.create_box(*(2 * HALF)).subdivide_midpoint(5)
    points = np.asarray(shape.vertices) - HALF
    top = points[:, 2] > HALF[2] - 1e-6
    gap = np.minimum(HALF[0] - np.abs(points[top, 0]), HALF[1] - np.abs(points[top, 1]))
    points[top, 2] += np.tan(np.radians(slope)) * gap
    return TriangleMesh(points.astype(np.float32), np.asarray(shape.triangles, np.int32))


@pytest.mark.parametrize("levels, true", [(STEEP, 0.0), (STEEP, 35.0), (LEVELS, 0.0)])
def test_a_roof_becomes_a_plane_if_no_camera_looks_from_low(
    levels: tuple[float, float, float], true: float
) -> None:
    mesh = roofed_box(35.0)
    is_flat, done = upper(mesh, glimpses_of(mesh, roofed_box(true), far, levels))
    assert is_flat == (levels == STEEP and true == 0)
    top = (np.abs(mesh.vertices[:, :2]) < HALF[:2] - 0.1).all(1) & (mesh.vertices[:, 2] > 0.2)
    height = np.abs(done.vertices[top, 2] - HALF[2]).max()
    assert height < 0.02 if is_flat else height > 0.2


def knob(places: F64, away: F64) -> F64:
    """The room, and a dark knob in the middle of the top."""
    on = (np.hypot(places[:, 0], places[:, 1]) < 0.12) & (places[:, 2] > 0.2)
    return np.where(on[:, None], 0.0, far(places, away))


def test_what_stands_on_a_plane_is_not_made_flat() -> None:
    mesh = roofed_box(35.0)
    views = glimpses_of(mesh, roofed_box(0.0), knob, STEEP)
    is_flat, done = upper(mesh, views)
    assert is_flat
    away = np.hypot(*mesh.vertices[:, :2].T)
    top = (np.abs(mesh.vertices[:, :2]) < HALF[:2] - 0.1).all(1) & (mesh.vertices[:, 2] > 0.2)
    height = np.abs(done.vertices[:, 2] - HALF[2])
    assert height[top & (away > 0.25)].max() < 0.02
    assert height[top & (away < 0.06)].min() > 0.02


@pytest.mark.parametrize("light", [far, plain])
def test_a_bulge_stays_that_mirrors_as_a_bulge_or_tells_nothing(light: Light) -> None:
    mesh = bulged_box(0.06)
    is_flat, done = upper(mesh, glimpses_of(mesh, mesh, light))
    assert not is_flat
    top = mesh.vertices[:, 2] > HALF[2] + 0.04
    assert np.abs(done.vertices[top] - mesh.vertices[top]).max() < 0.01


def test_without_views_no_bulge_is_looked_for() -> None:
    mesh = bulged_box(0.06)
    told = np.zeros(len(mesh.vertices))
    flats = flats_of(mesh, on_edges(mesh), told, limit=LIMIT, diameter=DIAMETER)
    assert all(flat.normal[2] < 0.9 for flat in flats)


def test_what_is_mirrored_from_the_ground_is_compared_by_its_place() -> None:
    wall = bulged_box(0)
    raised = TriangleMesh(wall.vertices + np.float32([0, 0, 0.3]), wall.faces)  # on the ground
    views = glimpses_of(raised, raised, ground)
    side = (raised.vertices[:, 0] > HALF[0] - 1e-6) & (np.abs(raised.vertices[:, 1]) < 0.3)
    points = raised.vertices[side].astype(float)
    normals = np.tile([1.0, 0, 0], (len(points), 1))
    known = mirror_agreement(points, normals, views, near=0.05, ground=UP)
    unknown = mirror_agreement(points, normals, views, near=0.05)
    assert known.misfit < 0.3 * known.spread
    assert unknown.misfit > 2 * known.misfit


def test_nothing_seen_gives_no_agreement() -> None:
    views = glimpses_of(bulged_box(0), bulged_box(0), far)
    found = mirror_agreement(np.full((5, 3), 9.0), np.tile(UP, (5, 1)), views, near=0.05)
    assert found.count == 0
    assert np.isnan(found.misfit)


def test_a_glimpse_is_a_small_picture_of_a_view() -> None:
    K = np.array([[700.0, 0, 480], [0, 700, 360], [0, 0, 1]])
    camera = Camera("a", 960, 720, K, np.eye(4))
    maps = [np.ones((720, 960), np.float32)] * 2
    colours = np.ones((720, 960, 3), np.float32)
    alpha = maps[1].copy()
    alpha[:, :480] = 0.5
    view = SurfaceMap(camera, maps[0], alpha, colours, colours, colours, maps[0], colours)
    glimpse = Glimpse.of(view)
    assert glimpse.depth.shape == glimpse.color.shape[:2] == (240, 320)
    assert (glimpse.depth[:, :155] == 0).all()
    assert (glimpse.depth[:, 165:] == 1).all()
    assert glimpse.camera.K[0, 0] == pytest.approx(700 / 3)


def painted(places: F64, _: F64) -> F64:
    """Stripes by place: matte paint."""
    return 0.5 + 0.4 * np.sin(8 * places)


@pytest.mark.parametrize(
    ("true", "light", "bad"), [(0, painted, False), (0.06, far, False), (0, far, True)]
)
def test_what_has_one_colour_or_one_reflection_is_explained(
    true: float, light: Light, bad: bool
) -> None:
    mesh = bulged_box(0.06 if light is far else 0)
    top = mesh.vertices[:, 2] > HALF[2] - 0.01
    share = unexplained(
        mesh.vertices.astype(float),
        mesh.vertex_normals().astype(float),
        np.where(top, 1.0, 0.0),
        links_of(mesh.faces),
        glimpses_of(mesh, bulged_box(true), light),
        near=0.05,
    )
    assert share is not None
    assert share > 0.5 if bad else share < 0.15


def test_what_no_view_sees_is_not_judged() -> None:
    mesh = bulged_box(0)
    views = glimpses_of(mesh, mesh, far)
    points = mesh.vertices.astype(float) + 9
    normals = mesh.vertex_normals().astype(float)
    area = np.ones(len(points))
    assert unexplained(points, normals, area, links_of(mesh.faces), views, near=0.05) is None
