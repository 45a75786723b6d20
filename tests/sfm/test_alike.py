"""Photos that were placed close together have to show the same."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Exif, View, Views
from refdgs_pipe.camera import F64, Camera, Lens
from refdgs_pipe.sfm import alike
from refdgs_pipe.sfm.alike import Agreement, agreement

SIDE, FOCAL = 160, 200.0
K = np.array([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1.0]])


def camera(name: str, x: float) -> Camera:
    """At (x, 0, -3), looking along z."""
    pose = np.eye(4)
    pose[:3, 3] = [-x, 0.0, 3.0]
    return Camera(name, SIDE, SIDE, K, pose)


def seen(pose: Camera, board: F64, light: float) -> np.ndarray:
    """A board in the plane z = 0, 8 units wide, as the camera sees it; times some light."""
    rays = pose.pixel_rays()
    places = pose.center[:2] + 3.0 * rays[..., :2]
    x, y = (np.float32((places[..., i] + 4) * len(board) / 8 - 0.5) for i in (0, 1))
    picture = cv2.remap(board.astype(np.float32), x, y, cv2.INTER_LINEAR)
    return np.clip(picture * light, 0, 255).astype(np.uint8)


def found(
    folder: Path, boards: list[F64], lights: list[F64 | float], object_z: float = 0.0
) -> Agreement:
    """Two photos from nearly the same place, each of its own board; both see the middle points."""
    rng = np.random.default_rng(1)
    points = np.concatenate([rng.uniform(-0.9, 0.9, (200, 2)), np.zeros((200, 1))], 1)
    points = points[np.argsort(points[:, 0])]
    items, cameras = [], []
    (folder / "images").mkdir(parents=True)
    for i, board in enumerate(boards):
        one = camera(f"IMG_{i}", 0.2 * i)
        grey = seen(one, board, 1.0) * lights[i]
        cv2.imwrite(str(folder / f"images/IMG_{i}.png"), cv2.merge([np.uint8(grey)] * 3))
        name = f"IMG_{i}"
        taken = (None, "train", Exif(), 1.0, 0.3, None, f"{name}.jpg")
        items.append(View(name, f"images/{name}.png", SIDE, SIDE, *taken))
        cameras.append(one)
    views = Views(folder, tuple(items), "srgb", "photo")
    model = SparseModel(
        cameras=tuple(cameras),
        lenses={c.name: Lens(K, np.zeros(8)) for c in cameras},
        points=points,
        point_colors=np.zeros((200, 3), np.uint8),
        tracks={"IMG_0": np.arange(120), "IMG_1": np.arange(80, 200)},
        ball=Ball(np.array([0.1, 0.0, object_z]), 1.0),
        up=np.array([0.0, 0.0, 1.0]),
        sfm_from_world=np.eye(4),
        metres_per_unit=None,
        lost=(),
    )
    return agreement(model, views)


def board(seed: int) -> F64:
    noise = np.random.default_rng(seed).uniform(0, 255, (512, 512))
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5), np.float64) * 3 - 255


def test_photos_of_one_board_agree_whatever_their_exposure(tmp_path: Path) -> None:
    same = found(tmp_path / "a", [board(0), board(0)], [1.0, 1.0])
    assert same.pairs == 2
    assert same.share > 0.9
    assert same.uneven < 0.02
    assert same.told == 2
    assert same.other_light < 0.02
    assert found(tmp_path / "b", [board(0), board(0)], [0.9, 0.5]).share > 0.9


def test_photos_of_two_boards_with_a_common_part_in_one_place_do_not_agree(tmp_path: Path) -> None:
    other, common = board(1), slice(512 // 2 - 24, 512 // 2 + 24)
    other[:, common] = board(0)[:, common]
    two = found(tmp_path, [board(0), other], [1.0, 1.0])
    assert two.pairs == 2
    assert two.share < 0.4


def test_photos_whose_matched_points_do_not_look_alike_tell_nothing(tmp_path: Path) -> None:
    """False matches made them seem close."""
    assert found(tmp_path, [board(0), board(1)], [1.0, 1.0]).pairs == 0


def test_light_that_falls_otherwise_does_not_agree(tmp_path: Path) -> None:
    slope = np.linspace(0.2, 1.0, SIDE)[None, :]
    uneven = found(tmp_path, [board(0), board(0)], [slope, slope[:, ::-1]])
    assert uneven.share < 0.5
    assert uneven.near == 2
    assert uneven.uneven > 0.2
    assert uneven.told == 2
    assert uneven.other_light > 0.2


def test_photos_far_from_each_other_are_not_compared(tmp_path: Path) -> None:
    one = found(tmp_path, [board(0)], [1.0])
    assert one.pairs == 0
    assert one.share == pytest.approx(float("nan"), nan_ok=True)


def test_photos_of_different_sides_that_share_a_far_wall_are_not_compared(tmp_path: Path) -> None:
    """The object stands in front of the board: the photos are turned about it by 20 degrees."""
    assert found(tmp_path, [board(0), board(1)], [1.0, 1.0], object_z=-2.4).pairs == 0
    same = tmp_path / "same"
    assert found(same, [board(0), board(0)], [1.0, 1.0], object_z=-2.4).pairs == 0


@pytest.mark.parametrize("close, far, share", [(12, 40, 1.0), (3, 40, 0.0), (3, 0, 1.0)])
def test_pairs_further_apart_count_only_where_close_ones_are_few(
    monkeypatch: pytest.MonkeyPatch, close: int, far: int, share: float
) -> None:
    """Close photos agree; more is hidden from one of two photos that are further apart."""
    pairs = [(5.0, 1.0, 1.0)] * close + [(14.0, 1.0, 0.0)] * far
    assert _agreement_of(pairs, monkeypatch).share == share


def test_what_a_photo_from_afar_sees_beside_the_object_is_not_asked_of_a_nearer_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pairs = [(5.0, 0.6, 1.0), (5.0, 1.7, 0.0)] * 4
    found = _agreement_of(pairs, monkeypatch)
    assert (found.pairs, found.share) == (4, 1.0)


def _agreement_of(
    pairs: list[tuple[float, float, float]], monkeypatch: pytest.MonkeyPatch
) -> Agreement:
    """Of pairs of (degrees apart, how many times as far the first is, how alike they look)."""

    class Pictures:
        def __init__(self, *_: object) -> None:
            pass

        def compared(self, one: Camera, _: object, points: F64) -> tuple[F64, F64, F64]:
            like = float(one.name) if points[0, 0] == 1 else 1.0
            return np.zeros(40), np.full(40, like), np.ones(40)

    def found_pairs(_: object) -> list[alike._Pair]:
        shared, rest = np.zeros(20, np.int64), np.ones(20, np.int64)
        cameras = [camera(str(like), 0.0) for _, _, like in pairs]
        return [
            alike._Pair(one, one, angle, farther, shared, rest)
            for one, (angle, farther, _) in zip(cameras, pairs, strict=True)
        ]

    monkeypatch.setattr(alike, "_close", found_pairs)
    monkeypatch.setattr(alike, "_Pictures", Pictures)
    model = SimpleNamespace(points=np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
    return agreement(model, None)  # type: ignore[arg-type]
