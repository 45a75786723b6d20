"""Size from two points that the user marked and measured."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mat_scene import SIZE, projected, ring, unseen

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.camera import Camera, Lens
from refdgs_pipe.errors import InputError
from refdgs_pipe.sfm.two_points import (
    Marked,
    TwoPoints,
    marked_photos,
    metres_per_unit,
    parsed,
    with_distance,
)

TEXT = "a.jpg:812,455 a.jpg:1200.5,460 b.jpg:640,300 b.jpg:1012,310 0.23"
POINTS = np.array([[-0.05, 0.02, 0.0], [0.06, 0.01, 0.04]])  # metres
UNIT = 0.2  # metres


def test_marks_are_read_in_any_order_of_photos() -> None:
    points = parsed(TEXT)
    assert points.metres == 0.23 and sorted(points.marks) == ["a.jpg", "b.jpg"]
    assert points.marks["a.jpg"].tolist() == [[812, 455], [1200.5, 460]]
    mixed = parsed("b.jpg:640,300 a.jpg:812,455 b.jpg:1012,310 a.jpg:1200.5,460 0.23")
    assert np.array_equal(mixed.marks["b.jpg"], points.marks["b.jpg"])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no length"),
        ("a.jpg:1,2 a.jpg:3,4 b.jpg:1,2 b.jpg:3,4", "no length"),
        ("a.jpg:1,2 a.jpg:3,4 b.jpg:1,2 b.jpg:3,4 -1", "0.0001 to 10000"),
        ("a.jpg:1,2 a.jpg:3,4 b.jpg:1,2 b.jpg:3,4 nan", "0.0001 to 10000"),
        ("a.jpg:1,2 a.jpg:3,4 0.2", "1 photos are marked"),
        ("a.jpg:1,2 b.jpg:1,2 b.jpg:3,4 0.2", "a.jpg has 1 mark:"),
        ("a.jpg:1;2 a.jpg:3,4 b.jpg:1,2 b.jpg:3,4 0.2", "no mark in a photo"),
        ("0.2", "0 photos are marked"),
    ],
)
def test_what_is_wrong_is_said(text: str, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        parsed(text)


def marked(k1: float = 0.0) -> tuple[TwoPoints, dict[str, Marked]]:
    """Three photos in a reconstruction whose unit is 0.2 m, and true marks in them."""
    photos, marks = {}, {}
    for name, pose in zip("abc", ring(3, 40), strict=True):
        shot = unseen(pose, k1)
        marks[name] = projected(shot, POINTS)
        placed = pose.copy()
        placed[:3, 3] /= UNIT
        lens = Lens(shot.K, np.array([k1, 0, 0, 0, 0, 0, 0, 0]))
        photos[name] = Marked(lens, placed, *SIZE)
    return TwoPoints(marks, float(np.linalg.norm(POINTS[0] - POINTS[1]))), photos


@pytest.mark.parametrize("k1", [0.0, -0.2])
def test_the_unit_is_found(k1: float) -> None:
    points, photos = marked(k1)
    assert metres_per_unit(points, photos) == pytest.approx(UNIT, rel=1e-4)


def test_a_pixel_more_or_less_changes_little() -> None:
    points, photos = marked()
    rough = {name: np.round(marks) for name, marks in points.marks.items()}
    found = metres_per_unit(TwoPoints(rough, points.metres), photos)
    assert found == pytest.approx(UNIT, rel=0.01)


def test_marks_of_different_points_are_refused() -> None:
    points, photos = marked()
    swapped = points.marks | {"b": points.marks["b"][::-1]}
    with pytest.raises(InputError, match="do not show one point"):
        metres_per_unit(TwoPoints(swapped, points.metres), photos)


def test_photos_from_one_place_and_strange_names_are_refused() -> None:
    points, photos = marked()
    same = {"a": photos["a"], "b": photos["a"]}
    twice = TwoPoints({"a": points.marks["a"], "b": points.marks["a"]}, 0.2)
    with pytest.raises(InputError, match="nearly one direction"):
        metres_per_unit(twice, same)
    with pytest.raises(InputError, match="b is no photo that has a place"):
        metres_per_unit(points, {"a": photos["a"]})
    outside = TwoPoints(points.marks | {"c": points.marks["c"] + 900}, 0.2)
    with pytest.raises(InputError, match="outside of it"):
        metres_per_unit(outside, photos)


def test_marks_count_the_pixels_of_the_users_files(tmp_path: Path) -> None:
    """The pipeline's images are smaller than the files; names and sizes are the files' own."""
    points, photos = marked()
    cameras, lenses, items = [], {}, []
    for name, p in photos.items():
        cameras.append(Camera(name, *SIZE, p.lens.K, p.cam_from_world, "train"))
        lenses[name] = p.lens
        image = f"images/{name}.png"
        items.append(View(name, image, *SIZE, None, "train", Exif(), 0, 0, None, f"day/{name}.jpg"))
    model = SparseModel(
        tuple(cameras),
        lenses,
        np.zeros((0, 3)),
        np.zeros((0, 3), np.uint8),
        {},
        Ball(np.zeros(3), 1.0),
        np.array([0, 0, 1.0]),
        np.eye(4),
        None,
        (),
    )
    views = Views(tmp_path, tuple(items), "srgb", "photo")
    sizes = {f"day/{name}.jpg": (4 * SIZE[0], 4 * SIZE[1]) for name in "abc"}
    large = {f"day/{name}.jpg": 4 * marks for name, marks in points.marks.items()}
    found = metres_per_unit(TwoPoints(large, points.metres), marked_photos(model, views, sizes))
    assert found == pytest.approx(UNIT, rel=1e-4)
    text = (
        " ".join(f"{f}:{x},{y}" for f, marks in large.items() for x, y in marks)
        + f" {points.metres}"
    )
    larger = [replace(view, source_size=(4 * SIZE[0], 4 * SIZE[1])) for view in items]
    told = with_distance(model, replace(views, items=tuple(larger)), text)
    assert told.metres_per_unit == pytest.approx(UNIT, rel=1e-4)
    assert with_distance(model, views, " ") is model
