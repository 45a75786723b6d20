"""Up, support, ball and the world frame, on cameras and points whose truth is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refdgs_pipe.artifacts.photos import load_photo
from refdgs_pipe.artifacts.sparse_model import Ball, Lost, SparseModel
from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.camera import F64, Camera, Lens
from refdgs_pipe.errors import CorruptError, PoseError
from refdgs_pipe.files.images import write_png
from refdgs_pipe.sfm.ball import (
    carved_ball,
    enclosing_ball,
    focus_point,
    grown_ball,
    seen_radius,
)
from refdgs_pipe.sfm.frame import moved, similarity
from refdgs_pipe.sfm.posed import in_world_frame, shots_of
from refdgs_pipe.sfm.report import overridden
from refdgs_pipe.sfm.support import level_up, off_planes, support_plane

WIDTH, HEIGHT, FOCAL = 160, 120, 160.0
TARGET = np.array([0.2, -0.1, 0.5])


def ring(count: int = 24, *, arc_deg: float = 360.0, down_deg: float = 30.0) -> list[Camera]:
    """Cameras on a circle of radius 4 around TARGET, looking down at it, z up."""
    cameras = []
    for i in range(count):
        turn = np.radians(arc_deg) * i / count
        down = np.radians(down_deg)
        back = np.array([np.cos(turn) * np.cos(down), np.sin(turn) * np.cos(down), np.sin(down)])
        right = np.cross(-back, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-back, right), -back])
        pose = similarity(1.0, rotation, -rotation @ (TARGET + 4 * back))
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
        cameras.append(Camera(f"v{i:02d}", WIDTH, HEIGHT, K, pose))
    return cameras


def table_and_object() -> F64:
    """A table at z = 0 and an object's cloud of radius 0.4 around TARGET."""
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-2, 2, (1500, 2)), rng.normal(0, 0.003, 1500)])
    cloud = rng.normal(size=(300, 3))
    cloud = TARGET + 0.4 * cloud / np.linalg.norm(cloud, axis=1, keepdims=True)
    return np.concatenate([table, cloud])


def sparse(cameras: list[Camera], points: F64) -> SparseModel:
    return SparseModel(
        cameras=tuple(cameras),
        lenses={camera.name: Lens(camera.K, np.zeros(8)) for camera in cameras},
        points=points,
        point_colors=np.zeros((len(points), 3), np.uint8),
        tracks={camera.name: np.arange(5) for camera in cameras},
        ball=Ball(np.zeros(3), 1.0),
        up=np.array([0.0, 0.0, 1.0]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(Lost("v99", "shares too few features with the others"),),
    )


def views_of(cameras: list[Camera], folder: Path) -> Views:
    items = tuple(
        View(c.name, f"images/{c.name}.png", c.width, c.height, None, "train", Exif(), 1.0, 0.5,
             None, f"{c.name}.jpg")
        for c in cameras
    )  # fmt: skip
    return Views(folder, items, "srgb", "photo")


def elsewhere() -> F64:
    """COLMAP's frame: turned, scaled, shifted."""
    q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    return similarity(2.5, q * np.sign(np.linalg.det(q)), np.array([3.0, -1.0, 7.0]))


def test_cameras_that_look_at_a_point_find_it() -> None:
    cameras = ring()
    np.testing.assert_allclose(focus_point(tuple(cameras)), TARGET, atol=1e-6)
    astray = replace(cameras[0], name="x", cam_from_world=cameras[0].cam_from_world + np.eye(4)[3])
    np.testing.assert_allclose(focus_point((*cameras, astray)), TARGET, atol=0.05)


def test_the_seen_radius_is_that_of_the_largest_ball_in_the_picture() -> None:
    expected = 4 * np.sin(np.arctan(HEIGHT / 2 / FOCAL))
    assert seen_radius(tuple(ring()), TARGET) == pytest.approx(expected)


def test_cameras_that_look_outwards_show_no_object(tmp_path: Path) -> None:
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    cameras = [replace(c, cam_from_world=turned @ c.cam_from_world) for c in ring()]
    with pytest.raises(PoseError, match="fewer than half of the 24 cameras see the point"):
        in_world_frame(sparse(cameras, table_and_object()), views_of(cameras, tmp_path))


@pytest.mark.parametrize("arc_deg", [360.0, 120.0])
def test_up_is_found_from_cameras_that_look_down(arc_deg: float) -> None:
    """On part of a circle the photos' mean up leans; the level axes do not."""
    up = level_up(tuple(ring(arc_deg=arc_deg)))
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)


def test_the_table_is_found_and_the_object_is_what_is_not_on_it() -> None:
    points = table_and_object()
    plane = support_plane(points, TARGET, 1.2, np.array([0.1, 0.0, 0.995]))
    assert plane is not None
    assert np.degrees(np.arccos(plane.normal[2])) < 0.2
    assert plane.heights(np.array([[0.0, 0.0, 0.0]]))[0] == pytest.approx(0, abs=0.003)
    rest = off_planes(points, TARGET, 1.2)
    assert np.linalg.norm(rest - TARGET, axis=1).max() < 0.41


def test_a_few_points_are_no_table() -> None:
    rng = np.random.default_rng(0)
    assert support_plane(rng.normal(size=(10, 3)), np.zeros(3), 1.0, np.eye(3)[2]) is None
    assert support_plane(rng.normal(size=(500, 3)), np.zeros(3), 1.0, np.eye(3)[2]) is None


def test_a_ball_grows_only_where_solid_points_crowd_its_rim() -> None:
    cloud = table_and_object()[-300:]
    fits = Ball(TARGET, 0.8)
    assert grown_ball(fits, cloud) is fits
    small = grown_ball(Ball(TARGET, 0.35), cloud)
    assert 0.39 < small.radius < 0.45


def test_photos_from_one_side_have_a_ball_that_holds_what_lies_near_it() -> None:
    rng = np.random.default_rng(0)
    wide = TARGET + rng.normal(size=(400, 3)) * (0.3, 0.3, 0.02)
    assert grown_ball(Ball(TARGET, 0.5), wide).radius == 0.5
    held = grown_ball(Ball(TARGET, 0.5), wide, one_sided=True)
    assert 0.6 < held.radius <= 0.8
    inside = np.linalg.norm(wide - held.center, axis=1) < held.radius
    assert inside.mean() > 0.9
    few = grown_ball(Ball(TARGET, 0.5), wide[:50], one_sided=True)
    assert few.radius == 0.5


def test_the_enclosing_ball_is_nearly_the_smallest() -> None:
    cube = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), float).reshape(3, -1).T + 5
    ball = enclosing_ball(cube)
    np.testing.assert_allclose(ball.center, [5, 5, 5], atol=0.02)
    assert np.sqrt(3) <= ball.radius < 1.01 * np.sqrt(3)


def test_masks_carve_the_ball_of_what_they_show() -> None:
    cameras = tuple(ring(down_deg=10) + ring(down_deg=55))
    cameras = tuple(replace(c, name=f"{i}") for i, c in enumerate(cameras))
    masks = []
    for camera in cameras:
        middle, depth = camera.project(TARGET[None])
        y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
        radius = FOCAL * 0.6 / np.sqrt(depth[0] ** 2 - 0.36)
        masks.append((np.hypot(x - middle[0, 0], y - middle[0, 1]) < radius).astype(np.float32))
    ball = carved_ball(cameras, masks, Ball(TARGET + 0.2, 1.2))
    assert ball is not None
    np.testing.assert_allclose(ball.center, TARGET, atol=0.06)
    assert 0.6 <= ball.radius < 0.75
    nothing = [np.zeros_like(mask) for mask in masks]
    assert carved_ball(cameras, nothing, Ball(TARGET, 1.2)) is None


def test_photos_get_a_frame_with_z_up_on_the_table_and_the_ball_as_unit(tmp_path: Path) -> None:
    cameras, points = ring(), table_and_object()
    truth = sparse(cameras, points)
    model = in_world_frame(moved(truth, elsewhere()), views_of(cameras, tmp_path))
    assert model.ball.radius == pytest.approx(1.0)
    np.testing.assert_allclose(model.ball.center[:2], 0, atol=1e-6)
    np.testing.assert_allclose(model.up, [0, 0, 1], atol=1e-9)
    heights = model.points[:1500, 2]
    assert np.abs(np.median(heights)) < 0.002 and heights.std() < 0.005
    front = model.cameras[0].center
    assert front[1] < 0 and abs(front[0]) < 1e-6
    for camera, before in zip(model.cameras, cameras, strict=True):
        uv, _ = camera.project(model.points)
        np.testing.assert_allclose(uv, before.project(points)[0], atol=1e-6)
        np.testing.assert_allclose(
            camera.cam_from_world[:3, :3] @ camera.cam_from_world[:3, :3].T, np.eye(3), atol=1e-9
        )
    back = model.points @ model.sfm_from_world[:3, :3].T + model.sfm_from_world[:3, 3]
    np.testing.assert_allclose(back, points, atol=1e-6)  # `moved` had noted where it came from


def test_what_the_user_says_of_ball_and_up_counts(tmp_path: Path) -> None:
    cameras = ring()
    model = in_world_frame(sparse(cameras, table_and_object()), views_of(cameras, tmp_path))
    assert overridden(model, None, None, None).ball == model.ball
    changed = overridden(model, (0.0, 1.0, 0.0), (0.0, 0.5, 0.0), 2.0)
    assert changed.ball.radius == 2.0
    np.testing.assert_allclose(changed.ball.center, [0, 0, 0.5], atol=1e-9)
    np.testing.assert_allclose(changed.up, [0, 0, 1], atol=1e-9)
    for a, b in zip(model.cameras, changed.cameras, strict=True):
        np.testing.assert_allclose(
            a.project(model.points)[0], b.project(changed.points)[0], atol=1e-6
        )
    upside_down = overridden(model, (0.0, 0.0, -1.0), None, None)
    np.testing.assert_allclose(upside_down.points[:, 2], -model.points[:, 2], atol=1e-9)


def test_known_poses_keep_their_frame_whatever_up_is() -> None:
    model = sparse(ring(), table_and_object())
    changed = overridden(model, (0.0, 2.0, 0.0), None, None)
    assert changed.cameras == model.cameras
    np.testing.assert_array_equal(changed.up, [0, 1, 0])


def test_a_sparse_model_comes_back_from_disk(tmp_path: Path) -> None:
    model = in_world_frame(sparse(ring(), table_and_object()), views_of(ring(), tmp_path))
    model = replace(model, cameras=(replace(model.cameras[0], split="test"), *model.cameras[1:]))
    model.save(tmp_path)
    read = SparseModel.load(tmp_path)
    for a, b in zip(model.cameras, read.cameras, strict=True):
        assert (a.name, a.width, a.height, a.split) == (b.name, b.width, b.height, b.split)
        np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=1e-12)
        np.testing.assert_array_equal(a.K, b.K)
        np.testing.assert_array_equal(model.lenses[a.name].K, read.lenses[a.name].K)
        np.testing.assert_array_equal(model.tracks[a.name], read.tracks[a.name])
    np.testing.assert_array_equal(model.points, read.points)
    np.testing.assert_array_equal(model.ball.center, read.ball.center)
    assert (read.lost, read.metres_per_unit) == (model.lost, None)
    (tmp_path / "model.json").write_text("{}")
    with pytest.raises(CorruptError, match=r"model\.json"):
        SparseModel.load(tmp_path)


def test_photos_that_share_a_camera_share_a_lens(tmp_path: Path) -> None:
    views = views_of(ring(4), tmp_path)
    zoomed = replace(views.items[3], exif=Exif(make="A", focal_mm=50.0, focal_35mm=72.0))
    sizes = {view.name: (view.width, view.height) for view in views.items}
    shots = shots_of(replace(views, items=(*views.items[:3], zoomed)), sizes)
    assert [len(group.files) for group in shots] == [3, 1]
    assert shots[0].focal is None and shots[1].focal == pytest.approx(2.0 * WIDTH)


def test_a_photo_is_undistorted_as_its_lens_says(tmp_path: Path) -> None:
    """A point drawn where the lens shows it lands where the pinhole projects it."""
    camera = ring(1)[0]
    lens = Lens(camera.K, np.array([-0.3, 0.1, 0.01, -0.01, 0, 0, 0, 0]))
    ray = np.array([0.3, 0.2])
    r2 = float(ray @ ray)
    k1, k2, p1, p2 = lens.distortion[:4]
    bent = ray * (1 + k1 * r2 + k2 * r2**2) + np.array(
        [
            2 * p1 * ray[0] * ray[1] + p2 * (r2 + 2 * ray[0] ** 2),
            p1 * (r2 + 2 * ray[1] ** 2) + 2 * p2 * ray[0] * ray[1],
        ]
    )
    seen = bent * FOCAL + camera.K[:2, 2]
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    blob = np.exp(-((x - seen[0]) ** 2 + (y - seen[1]) ** 2) / 18)
    image = np.repeat((blob * 255).round().astype(np.uint8)[..., None], 3, axis=2)
    views = views_of([camera], tmp_path)
    write_png(tmp_path / "images" / f"{camera.name}.png", image)
    model = replace(sparse([camera], table_and_object()), lenses={camera.name: lens})
    photo = load_photo(views, model, camera)
    weight = photo.rgb[..., 0]
    center = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
    np.testing.assert_allclose(center, ray * FOCAL + camera.K[:2, 2], atol=0.25)
    assert photo.valid.all()  # a barrel lens saw more than the pinhole shows
    half = load_photo(views, model, camera, scale=0.5)
    assert half.rgb.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert half.rgb.mean() == pytest.approx(photo.rgb.mean(), rel=0.01)
