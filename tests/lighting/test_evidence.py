"""A ground that darkens away from the camera, and a background that stands still."""

import numpy as np
import pytest
from lighting.test_rings import UP, looking, on_table
from numpy.typing import NDArray

from refdgs_pipe.camera import Camera
from refdgs_pipe.lighting.evidence import Ground, falloff, placed_lamp, still_share

F64 = NDArray[np.float64]
CENTER, RADIUS = np.zeros(3), 0.6


def ground(lamp: float, room: float, place: tuple[float, float] = (0.0, 0.0)) -> Ground:
    """A mottled ground that a lamp at the camera, right and down of it, and the room light."""
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-2, 2, (400, 2)), np.zeros(400)])
    own = rng.uniform(0.2, 0.8, 400)
    cameras, seen = {}, {}
    for i in range(12):
        a = 2 * np.pi * i / 12
        camera = looking(np.array([3 * np.cos(a), 3 * np.sin(a), 2.0]), CENTER, f"{i}")
        at = np.array([*place, 0.0]) @ camera.cam_from_world[:3, :3] + camera.center
        towards = at - points
        square = (towards**2).sum(1)
        light = lamp * (towards @ UP) / np.sqrt(square) / square * 10 + room
        exposure = rng.uniform(0.5, 1.0)
        grey = own * light * exposure * rng.lognormal(0, 0.05, 400)
        cameras[camera.name] = camera
        seen[camera.name] = (np.arange(400), np.clip(grey, 0, 1))
    found = Ground.of(seen, cameras, points, UP)
    assert found is not None
    return found


def test_the_ground_follows_a_lamp_on_the_camera() -> None:
    slope, explained = falloff(ground(1.0, 0.0))
    assert slope == pytest.approx(1, abs=0.05)
    assert explained > 0.7


def test_the_ground_does_not_follow_a_lamp_in_the_room() -> None:
    slope, explained = falloff(ground(0.0, 0.6))
    assert slope == pytest.approx(0, abs=0.05)
    assert explained < 0.05


def test_a_lamp_and_a_room_together_lie_between() -> None:
    slope, _ = falloff(ground(0.6, 0.3))
    assert 0.25 < slope < 0.8


def test_a_weak_lamp_in_a_bright_room_is_told_by_what_it_explains() -> None:
    slope, explained = falloff(ground(0.2, 0.4))
    assert 0.12 < slope < 0.25
    assert explained > 0.3


def test_too_little_ground_says_nothing() -> None:
    camera = looking(np.array([3.0, 0, 2]), CENTER, "a")
    alone = {"a": (np.arange(5), np.full(5, 0.5))}
    assert Ground.of(alone, {"a": camera}, np.zeros((5, 3)), UP) is None


def pictures(cameras: tuple[Camera, ...], *, still: bool) -> list[NDArray[np.float32]]:
    rng = np.random.default_rng(0)
    same = rng.random((48, 64), np.float32)
    return [same if still else rng.random((48, 64), np.float32) for _ in cameras]


@pytest.mark.parametrize("still", [True, False])
def test_a_background_that_stands_still_is_seen(still: bool) -> None:
    cameras = on_table([(1.0, 2.5, 0)], 8, UP)
    share = still_share(pictures(cameras, still=still), list(cameras), CENTER, RADIUS)
    assert share > 0.9 if still else share < 0.1


def test_a_still_background_is_seen_though_the_exposure_changes() -> None:
    cameras = on_table([(1.0, 2.5, 0)], 8, UP)
    gains = np.linspace(0.8, 1.1, 8)  # of sRGB, nearly a stop in all
    same = [np.float32(g) * p for g, p in zip(gains, pictures(cameras, still=True), strict=True)]
    assert still_share(same, list(cameras), CENTER, RADIUS) > 0.9
    apart = [np.float32(g) * p for g, p in zip(gains, pictures(cameras, still=False), strict=True)]
    assert still_share(apart, list(cameras), CENTER, RADIUS) < 0.1


def test_a_plain_background_says_nothing() -> None:
    cameras = on_table([(1.0, 2.5, 0)], 8, UP)
    plain = [np.full((48, 64), 0.9, np.float32)] * 8
    assert still_share(plain, list(cameras), CENTER, RADIUS) == 0


@pytest.mark.parametrize("place", [(0.0, -0.6), (0.6, 0.0)])
def test_the_lamp_is_found_above_or_beside_the_lens(place: tuple[float, float]) -> None:
    lamp, room = placed_lamp(ground(1.0, 0.1, place), float(np.sqrt(13)))
    assert lamp == pytest.approx([*place, 0.0], abs=0.25)
    assert room < 0.3
