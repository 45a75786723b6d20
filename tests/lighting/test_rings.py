"""Rings of photos of a turntable are found by their poses; a camera in a hand makes none."""

import numpy as np
import pytest
from numpy.typing import NDArray

from refdgs_pipe.artifacts.lighting import angle_of, turned
from refdgs_pipe.camera import Camera, look_at
from refdgs_pipe.lighting.rings import find_rings

F64 = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


def looking(center: F64, target: F64, name: str) -> Camera:
    """A camera at `center` that looks at `target`, upright."""
    K = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    return Camera(name, 64, 48, K, look_at(center, target, UP), "train")


def on_table(rings: list[tuple[float, float, float]], each: int, axis: F64) -> tuple[Camera, ...]:
    """Photos of a turntable: (height, radius, azimuth in the room in degrees) of the tripod."""
    cameras = []
    for number, (height, radius, azimuth) in enumerate(rings):
        a = np.radians(azimuth)
        place = np.array([radius * np.cos(a), radius * np.sin(a), height])
        tripod = looking(place, np.array([0.0, 0.1, 0.2]), "tripod")
        for i in range(each):
            # the world is what turns with the table
            turn = np.eye(4)
            turn[:3, :3] = turned(axis, 2 * np.pi * i / each)
            pose = tripod.cam_from_world @ turn
            cameras.append(Camera(f"{number}_{i:02}", 64, 48, tripod.K, pose, "train"))
    return tuple(cameras)


def test_the_rings_of_a_turntable_are_found_with_their_axis() -> None:
    cameras = on_table([(1.0, 2.5, 0), (2.0, 1.8, 6)], 12, UP)
    found = find_rings(cameras, np.array([0.05, 0.0, 0.1]), np.array([0.02, 0.0, 1.0]))
    assert found is not None
    assert sorted(len(ring) for ring in found.members) == [12, 12]
    assert found.share == 1
    assert found.turntable.axis == pytest.approx(UP, abs=1e-6)
    assert found.turntable.center[:2] == pytest.approx([0, 0], abs=1e-6)
    sizes = {
        (round(r.height + found.turntable.center[2], 6), round(r.radius, 6))
        for r in found.turntable.rings
    }
    assert sizes == {(1.0, 2.5), (2.0, 1.8)}


def test_a_room_stands_still_for_all_photos_of_a_ring() -> None:
    cameras = on_table([(1.0, 2.5, 0)], 12, UP)
    found = find_rings(cameras, np.zeros(3), UP)
    assert found is not None
    rotations = [
        camera.cam_from_world[:3, :3] @ found.turntable.room_from_world(camera.center).T
        for camera in cameras
    ]  # from the room to the camera
    assert np.ptp(rotations, axis=0) == pytest.approx(np.zeros((3, 3)), abs=1e-6)


def test_a_camera_in_a_hand_makes_no_rings() -> None:
    rng = np.random.default_rng(4)
    cameras = []
    for i in range(30):
        a = 2 * np.pi * i / 30
        place = np.array([2.5 * np.cos(a), 2.5 * np.sin(a), 1.0]) + rng.normal(0, 0.15, 3)
        cameras.append(looking(place, rng.normal(0, 0.1, 3), f"{i:02}"))
    found = find_rings(tuple(cameras), np.zeros(3), UP)
    assert found is None or found.share < 0.5


def test_the_angle_of_a_rotation_is_read_back() -> None:
    axis = np.array([0.6, 0.0, 0.8])
    assert angle_of(turned(axis, -1.2), axis) == pytest.approx(-1.2)
