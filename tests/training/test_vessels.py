"""Level tops of hulls: lids, flat mirrors, and the vessels that they may close."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import Camera
from refdgs_pipe.mirrored import Room
from refdgs_pipe.ops import Pinhole
from refdgs_pipe.training import vessels
from refdgs_pipe.training.initial import Hull
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.vessels import (
    Plateau,
    find_mouth,
    find_plateau,
    find_roof,
    is_flat_top,
    mirror_misfit,
    without_roof,
)

UP = np.array([0.0, 0.0, 1.0])
TICKS = np.linspace(-1, 1, 48)
X, Y, Z = np.meshgrid(TICKS, TICKS, TICKS, indexing="ij")
RADIUS = np.hypot(X, Y)


def hull(cells: np.ndarray) -> Hull:
    return Hull(cells, TICKS, Ball(np.zeros(3), 1.0))


def closed_bowl() -> np.ndarray:
    """A cone that widens upwards, closed at its mouth as silhouettes close it."""
    return np.asarray((Z > -0.5) & (Z < 0.4) & (RADIUS < 0.3 + 0.6 * (Z + 0.5)))


def test_a_level_top_is_opened_as_a_vessel_with_even_walls() -> None:
    mouth = find_mouth(hull(closed_bowl()), UP)
    assert mouth is not None
    gone = mouth.hollow
    assert not (gone & ~closed_bowl()).any()
    assert gone.sum() > 0.5 * closed_bowl().sum()
    cell = TICKS[1] - TICKS[0]
    wall = 0.3 + 0.6 * (Z + 0.5) - RADIUS  # how far inside of the outer wall
    assert wall[gone].min() > 0.5 * cell
    assert (Z[gone] + 0.5).min() > cell  # the floor stays
    axis = (closed_bowl() & ~gone)[24, 24]
    assert not axis[TICKS > -0.3].any() and axis[TICKS < -0.45].any()


def test_what_photos_agreed_on_already_is_not_tried_again() -> None:
    mouth = find_mouth(hull(closed_bowl()), UP)
    assert mouth is not None
    dented = hull(closed_bowl() & (Z < 0.35))
    assert mouth.is_closed(dented)
    assert not mouth.is_closed(hull(closed_bowl() & ~mouth.hollow))


def test_a_domed_top_is_no_lid() -> None:
    dome = np.asarray((Z > -0.5) & (RADIUS**2 + (Z + 0.5) ** 2 < 0.8))
    assert find_mouth(hull(dome), UP) is None


def test_a_small_level_top_is_no_lid() -> None:
    cone = np.asarray((Z > -0.5) & (Z < 0.4) & (RADIUS < 0.75 - 0.65 * (Z + 0.5)))
    assert find_mouth(hull(cone), UP) is None


def test_a_thin_plate_has_no_hollow() -> None:
    plate = np.asarray((np.abs(Z) < 0.03) & (RADIUS < 0.8))
    assert find_mouth(hull(plate), UP) is None


SLAB = (np.abs(X) < 0.5) & (np.abs(Y) < 0.4)
BULGE = SLAB & (Z >= 0.2) & (0.2 + 0.3 * (0.45 - np.maximum(np.abs(X), np.abs(Y))) > Z)


def bulging_slab() -> Hull:
    """A slab whose flat top bulges, as where all cameras look down."""
    return hull(np.asarray((SLAB & (Z > -0.5) & (Z < 0.2)) | BULGE))


def lid_of(solid: Hull) -> np.ndarray:
    """The uppermost cell of each column."""
    top = solid.cells & ~np.roll(solid.cells, -1, axis=2)
    return np.asarray(solid.ticks[np.argwhere(top)])


@pytest.mark.parametrize("down", [False, True])
def test_a_bulge_on_a_level_part_is_what_lies_above_its_border(down: bool) -> None:
    solid = bulging_slab()
    if down:
        solid = replace(solid, cells=solid.cells[:, :, ::-1])
    lid = lid_of(bulging_slab()) * ([1, 1, -1] if down else 1)
    found = find_plateau(solid, lid, -UP if down else UP)
    assert found is not None and found.normal.tolist() == [0, 0, -1 if down else 1]
    bulge = BULGE[:, :, ::-1] if down else BULGE
    assert bulge.sum() > 300
    np.testing.assert_array_equal(found.bulge, bulge & solid.cells)
    assert np.ptp(found.points[:, 2]) == 0
    height = abs(float(found.points[0, 2]))
    assert 0.2 - 1.1 * (TICKS[1] - TICKS[0]) < height < 0.2
    assert find_plateau(solid, lid, np.array([0.0, 0.6, 0.8])) is None


BALL = Ball(np.zeros(3), 1.0)


def photos_of(
    normal: Callable[[np.ndarray], np.ndarray], spot: float = 0.0, walls: float | None = None
) -> list[TrainingPhoto]:
    """Photos of the plane z = 0 that mirrors a coloured sky, but for a dark round spot.

    Args:
        normal: (N, 3) at places (N, 3); spot: its radius, around x = 0.35 and y = 0.
        walls: how far away the sky is; None: infinitely.
    """
    out = []
    for turn in np.linspace(0, 2 * np.pi, 24, endpoint=False):
        tilt = np.deg2rad(55 if len(out) % 2 else 40)
        eye = 3 * np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
        forward = -eye / 3
        right = np.cross(forward, UP) / np.linalg.norm(np.cross(forward, UP))
        rotation = np.stack([right, np.cross(forward, right), forward])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
        K = np.array([[80.0, 0, 32], [0, 80.0, 32], [0, 0, 1]])
        camera = Camera(f"{len(out)}", 64, 64, K, pose)
        rays = camera.pixel_rays().reshape(-1, 3) @ rotation
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        place = eye - rays * (eye[2] / rays[:, 2:])
        n = normal(place)
        away = rays - 2 * (rays * n).sum(1, keepdims=True) * n
        if walls is not None:
            away = Room(BALL.center, walls).met(place, away)
        sky = 0.5 + 0.5 * np.sin(7 * away @ np.array([[1.0, 2, 0], [0, 1, -2], [1, 0, 1]]))
        sky[np.linalg.norm(place - [0.35, 0, 0], axis=1) < spot] = 0
        rgb = torch.from_numpy(np.round(255 * sky).astype(np.uint8).reshape(64, 64, 3))
        mask = torch.full((64, 64), 255, dtype=torch.uint8)
        pinhole = Pinhole.of(camera, 0.1)
        out.append(TrainingPhoto(camera, pinhole, rgb.permute(2, 0, 1).contiguous(), mask, None))
    return out


@pytest.mark.parametrize("walls", [None, 10.0, 4.0])
def test_photos_agree_on_a_flat_mirror_and_not_on_a_polished_hollow(walls: float | None) -> None:
    place = np.linspace(-0.6, 0.6, 30)
    x, y = (a.ravel() for a in np.meshgrid(place, place))
    plateau = Plateau(np.stack([x, y, 0 * x], 1), UP, np.zeros((2, 2, 2), bool), BALL)
    flat = mirror_misfit(photos_of(lambda p: np.tile(UP, (len(p), 1)), walls=walls), plateau)

    def bowl(p: np.ndarray) -> np.ndarray:
        tilted = UP - 0.9 * p
        return np.asarray(tilted / np.linalg.norm(tilted, axis=1, keepdims=True))

    hollow = mirror_misfit(photos_of(bowl, walls=walls), plateau)
    assert flat is not None and flat < 0.5 * vessels.A_MIRROR
    assert hollow is not None and hollow > 1.3 * vessels.A_MIRROR


def test_a_top_is_flat_if_it_mirrors_as_a_plane_or_shows_no_shading() -> None:
    place = np.linspace(-0.6, 0.6, 30)
    x, y = (a.ravel() for a in np.meshgrid(place, place))
    plateau = Plateau(np.stack([x, y, 0 * x], 1), UP, np.zeros((2, 2, 2), bool), BALL)

    def dome(p: np.ndarray) -> np.ndarray:
        tilted = UP + 0.9 * p
        return np.asarray(tilted / np.linalg.norm(tilted, axis=1, keepdims=True))

    def gray(low: int, high: int) -> list[TrainingPhoto]:
        shade = torch.linspace(low, high, 64).round().to(torch.uint8).expand(3, 64, 64)
        return [replace(photo, rgb=shade.contiguous()) for photo in photos_of(dome)]

    assert is_flat_top(photos_of(lambda p: np.tile(UP, (len(p), 1))), plateau)
    assert not is_flat_top(photos_of(dome), plateau)
    assert not is_flat_top(photos_of(dome)[:1], plateau)  # nothing to compare with
    assert is_flat_top(gray(130, 130), plateau)
    assert not is_flat_top(gray(90, 170), plateau)
    assert not is_flat_top(gray(6, 12), plateau)  # black, with little of shading


def cameras_at(degrees: float) -> list[Camera]:
    out = []
    for photo in photos_of(lambda p: np.tile(UP, (len(p), 1))):
        pose = photo.camera.cam_from_world.copy()
        flat = photo.camera.center * [1, 1, 0]
        level = np.deg2rad(degrees)
        eye = 3 * (np.cos(level) * flat / np.linalg.norm(flat) + np.sin(level) * UP)
        pose[:3, 3] = -pose[:3, :3] @ eye
        out.append(replace(photo.camera, cam_from_world=pose))
    return out


ROOF = (RADIUS < 0.6) & (Z >= 0) & (Z < 0.84 * (0.6 - RADIUS))  # as steep as 40 degrees
POST = (RADIUS < 0.6) & (Z > -0.6) & (Z < 0)


def test_a_roof_is_found_if_no_camera_looks_from_low() -> None:
    solid = hull(np.asarray(ROOF | POST))
    found = find_roof(solid, cameras_at(40), UP)
    assert found is not None
    bulge = found.bulge
    assert (bulge & ~ROOF).sum() < 0.05 * ROOF.sum() and (bulge & ROOF).sum() > 0.7 * ROOF.sum()
    assert find_roof(solid, cameras_at(30), UP) is None  # too steep for these
    assert find_roof(solid, [*cameras_at(40), *cameras_at(10)], UP) is None
    assert find_mouth(solid, UP) is None  # and it is no lid otherwise
    level = replace(solid, cells=solid.cells & ~bulge)
    mouth = find_mouth(level, UP)  # what is below may be a vessel
    assert mouth is not None and not (mouth.hollow & bulge).any()


def test_what_stands_on_a_flat_top_keeps_its_roof() -> None:
    solid = hull(np.asarray(ROOF | POST))
    found = find_roof(solid, cameras_at(40), UP)
    assert found is not None
    top = replace(found, points=found.points * [1, 1, 0])  # where the photos have it
    photos = photos_of(lambda p: np.tile(UP, (len(p), 1)), spot=0.15)
    assert is_flat_top(photos, top)
    left = without_roof(solid, photos, top)
    assert not (left & ~solid.cells).any()
    kept = (left & found.bulge).any(2)
    away = np.hypot(X - 0.35, Y)[:, :, 0]
    assert kept[away < 0.08].all() and not kept[away > 0.3].any()


def test_a_handle_that_rises_from_a_lid_is_no_part_of_it() -> None:
    handle = (np.abs(Y) < 0.4) & (np.abs(X - 0.5) < 0.3) & (Z > 0.3) & (Z < 0.3 + 0.7 * (X - 0.2))
    mouth = find_mouth(hull(closed_bowl() | handle), UP)
    assert mouth is not None
    assert mouth.lid[:, 2].max() < 0.6 < (0.3 + 0.7 * 0.6)
