"""Photos from one side: surfaces that neighbouring photos agree on, and where training starts."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import Box, Scene, constant, gradient_sky, look_at
from training.test_trainer import SMALL, model_of

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.errors import Cancelled
from refdgs_pipe.ops import Pinhole
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.stereo import agreed_surface, thinned
from refdgs_pipe.training.stereo_start import agreed_cloud

SIZE, FRONT = 120, 0.2


def grain(points: np.ndarray) -> np.ndarray:
    """A fine colourful texture, (N, 3) linear."""
    phases = np.array([[21.0, 13.0, 17.0], [-11.0, 23.0, 19.0], [15.0, -9.0, 27.0]])
    fine = np.sin(points @ phases.T) + np.sin(2.3 * points @ phases[::-1].T)
    return np.asarray(0.4 + 0.15 * fine)


def slab(texture: object = grain) -> Scene:
    """A step on a wall: fronts at x = 0.2 and x = 0."""
    step = Box((-0.2, -0.4, -0.4), (FRONT, 0.4, 0.4), texture)
    wall = Box((-0.4, -1.4, -1.4), (0.0, 1.4, 1.4), texture)
    return Scene((step, wall), gradient_sky)


def photos_of(scene: Scene, degrees: np.ndarray) -> tuple[list[TrainingPhoto], SparseModel]:
    """Photos from some azimuths at two heights, 3 away, of what lies towards +x."""
    cameras = []
    for i, azimuth in enumerate(np.radians(degrees)):
        height = np.radians(6 if i % 2 else 20)
        eye = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), 0])
        eye[2] = np.sin(height)
        cameras.append(look_at(f"v{i:03d}", 3 * eye, size=SIZE, focal=1.4 * SIZE))
    photos = []
    for camera in cameras:
        color = torch.from_numpy(scene.surface_map(camera).color).permute(2, 0, 1)
        pixels = (255 * color).round().to(torch.uint8).contiguous()
        photos.append(TrainingPhoto(camera, Pinhole.of(camera, 0.1), pixels, None, None))
    return photos, model_of(cameras, np.zeros((0, 3)))


@pytest.fixture(scope="module")
def one_side() -> tuple[list[TrainingPhoto], SparseModel]:
    return photos_of(slab(), np.linspace(-40, 40, 9))


def test_the_points_lie_on_the_surface_and_their_normals_point_out(
    one_side: tuple[list[TrainingPhoto], SparseModel],
) -> None:
    photos, model = one_side
    found = agreed_surface(model, photos)
    distance = slab().distance(found.points)
    assert np.median(distance) < 0.006
    assert np.quantile(distance, 0.95) < 0.04
    share = np.mean([seen[30:90, 30:90].mean() for seen in found.seen])
    assert share > 0.6
    front = (np.abs(found.points[:, 0] - FRONT) < 0.01) & (np.abs(found.points[:, 1:]) < 0.3).all(1)
    assert front.sum() > 1000
    assert np.median(found.normals[front, 0]) > 0.97


def test_the_number_of_threads_changes_nothing(
    one_side: tuple[list[TrainingPhoto], SparseModel],
) -> None:
    photos, model = one_side
    one, two = (agreed_surface(model, photos[:5], threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.points, two.points)


def test_plain_walls_and_single_photos_show_no_surface() -> None:
    plain, model = photos_of(slab(constant(0.4, 0.4, 0.4)), np.linspace(-40, 40, 9))
    middle = [seen[50:70, 50:70].mean() for seen in agreed_surface(model, plain).seen]
    assert np.mean(middle) < 0.05
    alone, model = photos_of(slab(), np.array([0.0]))
    assert len(agreed_surface(model, alone).points) == 0


def test_points_are_thinned_to_about_as_many_as_asked_for(
    one_side: tuple[list[TrainingPhoto], SparseModel],
) -> None:
    photos, model = one_side
    found = agreed_surface(model, photos[:5])
    every = np.ones(len(found.points), bool)
    points, normals, colors = thinned(found, every, 500)
    assert 300 < len(points) <= 500
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    assert ((colors >= 0) & (colors <= 1)).all()
    assert len(thinned(found, ~every, 500)[0]) == 0


def test_photos_from_one_side_start_there_and_what_was_found_is_kept(
    one_side: tuple[list[TrainingPhoto], SparseModel], tmp_path: Path
) -> None:
    photos, model = one_side
    cloud = agreed_cloud(SMALL.start, model, photos, tmp_path)
    assert cloud is not None
    assert np.median(slab().distance(cloud.points)) < 0.01
    told: list[int] = []
    again = agreed_cloud(SMALL.start, model, photos, tmp_path, lambda done, _: told.append(done))
    assert again is not None
    assert told == []  # read from the scratch folder
    np.testing.assert_array_equal(cloud.points, again.points)


def test_the_object_is_looked_for_where_photos_go_round_it_or_show_nothing(tmp_path: Path) -> None:
    round_it, model = photos_of(slab(), np.arange(0, 360, 30))
    assert agreed_cloud(SMALL.start, model, round_it, tmp_path / "round") is None
    plain, model = photos_of(slab(constant(0.4, 0.4, 0.4)), np.linspace(-40, 40, 5))
    (tmp_path / "plain").mkdir()
    assert agreed_cloud(SMALL.start, model, plain, tmp_path / "plain") is None
    asked = SMALL.but(unmasked="look")
    assert agreed_cloud(asked.start, model, plain, tmp_path / "look") is None


def test_the_comparison_can_be_stopped_and_leaves_nothing_half_done(
    one_side: tuple[list[TrainingPhoto], SparseModel], tmp_path: Path
) -> None:
    photos, model = one_side

    def stop(done: int, total: int) -> None:
        if done == 2:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        agreed_cloud(SMALL.start, model, photos, tmp_path, stop)
    assert list(tmp_path.iterdir()) == []
