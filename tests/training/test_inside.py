"""What photos see through the mouth of a vessel: how deep it is, and whether it is one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import Box, Colour, Scene, constant, look_at
from training.test_stereo import grain
from training.test_trainer import model_of

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.errors import Cancelled
from refdgs_pipe.ops import Pinhole
from refdgs_pipe.training.initial import Hull, closed_hull
from refdgs_pipe.training.inside import Inside, see_inside
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.vessels import Mouth, find_mouth

WIDE, TOP, FLOOR, WALL = 0.8, 0.5, -0.1, 0.08
LOW, INNER = -0.4, WIDE - WALL


def open_box(floor: float = FLOOR, color: Colour = grain) -> Scene:
    """A box of even walls whose floor lies at a height; a floor at TOP makes it a block."""
    walls = [
        Box((-WIDE, -WIDE, LOW), (-INNER, WIDE, TOP), color),
        Box((INNER, -WIDE, LOW), (WIDE, WIDE, TOP), color),
        Box((-WIDE, -WIDE, LOW), (WIDE, -INNER, TOP), color),
        Box((-WIDE, INNER, LOW), (WIDE, WIDE, TOP), color),
    ]
    return Scene((*walls, Box((-WIDE, -WIDE, LOW), (WIDE, WIDE, floor), color)), constant(0, 0, 0))


def photos_of(scene: Scene) -> tuple[list[TrainingPhoto], SparseModel]:
    """Photos from two rings, 4 away, with masks."""
    photos, cameras = [], []
    for ring, count in ((20.0, 8), (50.0, 20)):
        for turn in np.linspace(0, 2 * np.pi, count, endpoint=False):
            tilt = np.radians(ring)
            eye = [np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)]
            name = f"v{len(cameras):03d}"
            cameras.append(look_at(name, 4 * np.array(eye), size=128, focal=192.0))
    for camera in cameras:
        seen = scene.surface_map(camera)
        color = torch.from_numpy(np.round(255 * seen.color).astype(np.uint8))
        mask = torch.from_numpy((255 * seen.alpha).astype(np.uint8))
        pixels = color.permute(2, 0, 1).contiguous()
        photos.append(TrainingPhoto(camera, Pinhole.of(camera, 0.1), pixels, mask, None))
    model = model_of(cameras, np.zeros((0, 3)))
    return photos, replace(model, ball=Ball(np.zeros(3), 1.3))


def closed(photos: list[TrainingPhoto], model: SparseModel) -> tuple[Hull, Mouth]:
    found = closed_hull(model, photos)
    assert found is not None
    mouth = find_mouth(found, model.up)
    assert mouth is not None
    return found, mouth


@pytest.fixture(scope="module")
def box() -> tuple[list[TrainingPhoto], SparseModel, Hull, Mouth, Inside]:
    photos, model = photos_of(open_box())
    hull, mouth = closed(photos, model)
    found = see_inside(model, photos, hull, mouth)
    assert found is not None
    return photos, model, hull, mouth, found


def test_photos_see_through_a_mouth_down_to_the_floor(
    box: tuple[list[TrainingPhoto], SparseModel, Hull, Mouth, Inside],
) -> None:
    hull, mouth, found = box[2:]
    assert found.opens, found.words
    x, y, z = np.meshgrid(*hull.axes(), indexing="ij")
    room = (np.maximum(np.abs(x), np.abs(y)) < INNER) & (z > FLOOR)
    margin = 2 * hull.cell
    inner = (np.maximum(np.abs(x), np.abs(y)) < INNER - margin) & (z > FLOOR + margin)
    assert (hull.cells & inner & (z < TOP)).sum() > 5000  # silhouettes close it
    assert (found.vessel.cells & inner & (z < TOP)).sum() < 0.02 * (inner & (z < TOP)).sum()
    solid = hull.cells & ~room & (z < FLOOR - margin)
    assert (found.vessel.cells & solid).sum() > 0.98 * solid.sum()
    # walls of even thickness know nothing of the floor
    assert (~mouth.hollow & solid).sum() < 0.8 * solid.sum()


def test_a_printed_top_is_no_mouth() -> None:
    photos, model = photos_of(open_box(TOP))
    hull, mouth = closed(photos, model)
    found = see_inside(model, photos, hull, mouth)
    assert found is not None
    assert not found.opens
    assert found.rather < 1, found.words


def test_too_few_photos_from_above_tell_nothing(
    box: tuple[list[TrainingPhoto], SparseModel, Hull, Mouth, Inside],
) -> None:
    photos, model, hull, mouth, _ = box
    assert see_inside(model, photos[:8], hull, mouth) is None  # of the low ring
    assert see_inside(model, photos[:15], hull, mouth) is None


def test_the_number_of_threads_changes_nothing_and_a_stop_is_heard(
    box: tuple[list[TrainingPhoto], SparseModel, Hull, Mouth, Inside],
) -> None:
    photos, model, hull, mouth, found = box
    again = see_inside(model, photos, hull, mouth, threads=2)
    assert again is not None
    assert (again.through, again.rather) == (found.through, found.rather)
    np.testing.assert_array_equal(again.vessel.cells, found.vessel.cells)

    def stop(done: int, total: int) -> None:
        raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        see_inside(model, photos, hull, mouth, progress=stop)
