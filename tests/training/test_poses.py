"""Poses that are corrected with the field."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from emulation import emulated
from scipy.spatial.transform import Rotation
from training.test_trainer import SMALL, capture, quiet
from training_runs import trainer_of

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import Cancelled, TrainingError
from refdgs_pipe.training.poses import Poses

pytestmark = pytest.mark.usefixtures("coarse_start")

REFINED = SMALL.but(poses="refined", iterations=360, rate_poses=5e-3, pose_weight=0.1)
OFF = 0.02  # radians, and camera distances


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def found(folder: Path, *, size: int = 48) -> tuple[Views, SparseModel]:
    """The procedural pair as if its poses had been found."""
    views, model = capture(folder, size=size)
    return replace(views, items=tuple(replace(v, known=None) for v in views.items)), model


def moved(camera: Camera, numbers: np.ndarray) -> Camera:
    """The camera of a world that was turned and shifted, (6,) radians and units."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = Rotation.from_rotvec(numbers[:3]).as_matrix(), numbers[3:]
    return replace(camera, cam_from_world=camera.cam_from_world @ motion)


def disturbed(model: SparseModel) -> SparseModel:
    """Every camera a little off, in all directions alike."""
    rng = np.random.default_rng(0)
    by = rng.normal(0, OFF / np.sqrt(3), (len(model.cameras), 6))
    distance = np.linalg.norm(model.cameras[0].center)
    by[:, 3:] *= distance
    by -= by.mean(0)
    cameras = tuple(moved(c, n) for c, n in zip(model.cameras, by, strict=True))
    return replace(model, cameras=cameras)


def misses(field: SurfelField, given: SparseModel, truth: SparseModel) -> float:
    """RMS pixels by which points near the object are projected to a wrong place."""
    points = np.random.default_rng(1).normal(0, 0.5, (50, 3))
    off = [
        a.project(points)[0] - b.project(points)[0]
        for a, b in zip(given.placed(field.poses).cameras, truth.cameras, strict=True)
    ]
    return float(np.sqrt(np.square(off).sum(-1).mean()))


def test_disturbed_poses_are_put_right(tmp_path: Path) -> None:
    views, truth = found(tmp_path / "views")
    given = disturbed(truth)
    field = trainer_of(views, given, REFINED, tmp_path).run(quiet)
    before = misses(replace(field, poses={}), given, truth)
    assert before > 0.8
    assert misses(field, given, truth) < 0.65 * before  # it is 0.51


def test_a_large_weight_holds_the_poses(tmp_path: Path) -> None:
    views, truth = found(tmp_path / "views", size=32)
    params = REFINED.but(pose_weight=1e4, iterations=60)
    field = trainer_of(views, disturbed(truth), params, tmp_path).run(quiet)
    given = disturbed(truth)
    assert misses(field, given, given) < 0.1


def test_what_all_cameras_have_in_common_stays(tmp_path: Path) -> None:
    _, model = found(tmp_path)
    poses = Poses(model.cameras, model.ball, 0.01)
    points = torch.from_numpy(np.random.default_rng(2).normal(0, 0.5, (30, 3)))
    world = 1.05 * points + torch.tensor([0.1, 0.05, -0.1])  # grown and shifted
    for _ in range(30):
        for camera in model.cameras:
            pose = poses.pose(camera.name)
            seen = points @ pose[:3, :3].T + pose[:3, 3]
            wanted = world @ pose.detach().new_tensor(camera.cam_from_world[:3, :3]).T
            wanted = wanted + pose.detach().new_tensor(camera.cam_from_world[:3, 3])
            (seen[:, :2] / seen[:, 2:] - wanted[:, :2] / wanted[:, 2:]).square().sum().backward()
            poses.step()
    state = poses.state()["moves"]
    assert state.mean(0).abs().max() < 1e-12
    away = torch.from_numpy(np.stack([c.center for c in model.cameras]))
    assert float((state[:, 3:] * away).sum().abs()) < 1e-9


def test_a_pose_is_turned_about_the_balls_center(tmp_path: Path) -> None:
    _, model = found(tmp_path)
    ball = replace(model.ball, center=np.array([0.3, -0.2, 0.1]))
    camera = model.cameras[3]
    poses = Poses(model.cameras, ball, 0.01)
    state = poses.state()
    state["moves"][3] = torch.tensor([0.1, -0.2, 0.3, 0, 0, 0])
    poses.restore(state)
    new = replace(camera, cam_from_world=poses.found()[camera.name])
    np.testing.assert_allclose(
        new.project(ball.center[None])[0], camera.project(ball.center[None])[0]
    )
    turn = Rotation.from_matrix(camera.cam_from_world[:3, :3].T @ new.cam_from_world[:3, :3])
    np.testing.assert_allclose(turn.as_rotvec(), [0.1, -0.2, 0.3], atol=1e-12)


def test_refined_poses_survive_an_interruption(tmp_path: Path) -> None:
    views, model = found(tmp_path / "views", size=32)
    params = REFINED.but(iterations=30)
    for name in "ab":
        (tmp_path / name).mkdir()

    def stop(done: int, total: int, now: object, work: float) -> None:
        if done == 20:
            raise Cancelled("enough")

    whole = trainer_of(views, model, params, tmp_path / "a").run(quiet)
    with pytest.raises(Cancelled):
        trainer_of(views, model, params, tmp_path / "b").run(stop)
    resumed = trainer_of(views, model, params, tmp_path / "b").run(quiet)
    assert whole.poses.keys() == resumed.poses.keys() == {c.name for c in model.cameras}
    for name, pose in whole.poses.items():
        assert np.array_equal(pose, resumed.poses[name])
    assert any(not np.array_equal(whole.poses[c.name], c.cam_from_world) for c in model.cameras)


def test_the_emulated_kernels_give_the_poses_the_same_gradients(tmp_path: Path) -> None:
    views, model = found(tmp_path / "views", size=20)
    few = {"surfels": 150, "local_surfels": 100, "masked": "hull", "iterations": 8}
    params = REFINED.but(**few)
    (tmp_path / "cpu").mkdir()
    there = trainer_of(views, model, params, tmp_path / "cpu").run(quiet).poses
    with emulated():
        here = trainer_of(views, model, params, tmp_path).run(quiet).poses
    moves = [np.abs(there[c.name] - c.cam_from_world).max() for c in model.cameras]
    assert max(moves) > 1e-3
    for name, pose in there.items():
        np.testing.assert_allclose(here[name], pose, atol=1e-4)


def test_known_poses_are_not_refined_and_recorded_steps_not_asked_for(tmp_path: Path) -> None:
    views, model = capture(tmp_path / "known", size=32)
    assert trainer_of(views, model, REFINED, tmp_path).field.poses is None
    views, model = found(tmp_path / "found", size=32)
    with pytest.raises(TrainingError, match="cannot be recorded"):
        trainer_of(views, model, REFINED, tmp_path, cuda_graph=True)


def test_a_field_keeps_its_poses_and_a_model_takes_them(tmp_path: Path) -> None:
    views, model = found(tmp_path / "views", size=32)
    params = REFINED.but(iterations=1)
    field = trainer_of(views, model, params, tmp_path).run(quiet)
    first, second = model.cameras[:2]
    field = replace(field, poses={first.name: moved(first, np.full(6, 0.1)).cam_from_world})
    field.save(tmp_path)
    placed = model.placed(SurfelField.load(tmp_path).poses)
    assert np.array_equal(placed.cameras[0].cam_from_world, field.poses[first.name])
    assert np.array_equal(placed.cameras[1].cam_from_world, second.cam_from_world)
