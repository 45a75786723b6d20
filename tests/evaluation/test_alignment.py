"""Truth in a frame of its own, laid by its cameras."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import solids
from scenes import orbit

from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.truth import scene_truth_files
from refdgs_pipe.camera import Camera
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.evaluation.alignment import laid, read_true_centers, world_from_truth
from refdgs_pipe.evaluation.surface import score_surface

TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def similarity() -> np.ndarray:
    """The world from the truth: three times as large, turned, and elsewhere."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = 3 * TURN, (1, -2, 5)
    return out


def true_centers(cameras: list[Camera]) -> dict[str, np.ndarray]:
    back = np.linalg.inv(similarity())
    return {c.name: back[:3, :3] @ c.center + back[:3, 3] for c in cameras}


def test_a_truth_that_is_larger_turned_and_elsewhere_is_laid_by_its_cameras() -> None:
    cameras = orbit(16, size=64)
    found = world_from_truth(cameras, true_centers(cameras))
    assert found == pytest.approx(similarity(), abs=1e-9)
    ball = solids.sphere(8)
    moved = laid(ball, similarity())
    assert moved.vertices[3] == pytest.approx(3 * TURN @ ball.vertices[3] + (1, -2, 5), abs=1e-5)


def test_one_camera_in_a_wrong_place_does_not_move_the_truth() -> None:
    cameras = orbit(16, size=64)
    centers = true_centers(cameras)
    centers[cameras[5].name] = centers[cameras[5].name] + 0.5
    found = world_from_truth(cameras, centers)
    assert found == pytest.approx(similarity(), abs=1e-3)


def test_two_cameras_or_a_row_of_them_fix_nothing() -> None:
    cameras = orbit(16, size=64)
    centers = true_centers(cameras)
    assert world_from_truth(cameras[:2], centers) is None
    row = {camera.name: np.array([float(i), 0, 0]) for i, camera in enumerate(cameras)}
    assert world_from_truth(cameras, row) is None


def test_damaged_true_cameras_are_named(tmp_path: Path) -> None:
    path = tmp_path / "cameras_gt.json"
    for text in ("{}", "no JSON", json.dumps({"frames": [{"file": "a", "transform_matrix": [1]}]})):
        path.write_text(text)
        with pytest.raises(CorruptError, match=r"cameras_gt\.json: expected `frames`"):
            read_true_centers(path)


def test_the_table_under_an_object_is_not_held_against_it() -> None:
    """What is further from the truth than a twentieth of its diagonal does not count."""
    ball, cameras = solids.sphere(48), orbit(16, size=160, focal=200.0)
    floor = np.array([[-9, -9, -1], [9, -9, -1], [9, 9, -1], [-9, 9, -1]], np.float32)
    sides = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    both = solids.joined(ball, replace(ball, vertices=floor, faces=sides))
    alone = score_surface(both, cameras, ball)
    among = score_surface(both, cameras, ball, among_others=True)
    assert alone is not None and among is not None
    assert alone.accuracy is not None and alone.accuracy > 1
    assert among.accuracy is not None and among.accuracy < 0.05
    assert among.median_completeness == pytest.approx(0, abs=1e-6)
    assert among.left_out is not None and among.left_out > 0.9


def test_truth_beside_the_folder_of_images_belongs_to_the_photos(tmp_path: Path) -> None:
    images = tmp_path / "images"
    images.mkdir()
    for name in ("images/a.jpg", "gt_mesh.ply"):
        (tmp_path / name).write_bytes(b"")
    assert [name for name, _ in Capture((images,)).files()] == ["a.jpg"]
    (tmp_path / "cameras_gt.json").write_text("{}")
    names = [name for name, _ in Capture((images,)).files()]
    assert names == ["a.jpg", "cameras_gt.json", "gt_mesh.ply"]
    assert scene_truth_files(images).cameras == tmp_path / "cameras_gt.json"
