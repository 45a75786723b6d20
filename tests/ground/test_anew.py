"""Photos without a place, found on the picture of the ground that the others show."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from printed_ground import PLANE, SIZE, blots, capture, errors, nothing, right_model

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.camera import Camera, look_at
from refdgs_pipe.ground import anew
from refdgs_pipe.ground.anew import placed_anew
from refdgs_pipe.sfm.on_ground import laid_on_ground

LOST = ("IMG_00", "IMG_07")


def without(model: SparseModel, *names: str) -> SparseModel:
    """The model after these photos were lost; their lenses are known."""
    return replace(model, cameras=tuple(c for c in model.cameras if c.name not in names))


def apart(cameras: list[Camera], *names: str) -> dict[str, Camera]:
    """The cameras of lost photos: nothing is known of where they stand."""
    return {c.name: replace(c, cam_from_world=np.eye(4)) for c in cameras if c.name in names}


def placed(views: Views, cameras: list[Camera], *names: str, threads: int = 1) -> SparseModel:
    model = right_model(cameras)
    found = placed_anew(
        views, without(model, *names), PLANE, apart(cameras, *names), nothing, threads
    )
    return replace(model, cameras=tuple(c for c in model.placed(found).cameras if c.name in found))


def test_lost_photos_are_placed(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, blots())
    found = placed(views, cameras, *LOST)
    assert found.names == [*LOST]
    assert errors(found, [c for c in cameras if c.name in LOST]).max() < 0.4


def test_the_number_of_threads_changes_nothing(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, blots())
    one, two = (placed(views, cameras, *LOST, threads=n) for n in (1, 2))
    for a, b in zip(one.cameras, two.cameras, strict=True):
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)


def test_a_photo_of_another_ground_gets_no_place(tmp_path: Path) -> None:
    views, cameras = capture(tmp_path, blots())
    (tmp_path / "other").mkdir()
    capture(tmp_path / "other", blots(seed=8))
    (tmp_path / "other" / "IMG_07.png").replace(tmp_path / "IMG_07.png")
    assert placed(views, cameras, *LOST).names == ["IMG_00"]


def test_no_photo_is_placed_below_the_ground(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From there, the ground is mirrored: mirrored photos would fit."""
    views, cameras = capture(tmp_path, blots())
    above = cameras[7].cam_from_world
    below = above @ np.diag([1.0, 1.0, -1.0, 1.0])
    for pose, names in ((above, [*LOST]), (below, [])):
        monkeypatch.setattr(anew, "_agreed", lambda *_, found=pose: found)
        monkeypatch.setattr(anew, "_refined", lambda *given: given[-1])
        assert placed(views, cameras, *LOST).names == names


def test_no_photo_is_placed_on_a_ground_that_repeats(tmp_path: Path) -> None:
    """A place one period off fits as well."""
    cell = cv2.resize(blots()[:300, :300], (90, 90), interpolation=cv2.INTER_AREA)
    views, cameras = capture(tmp_path, np.tile(cell, (10, 10, 1)))
    assert placed(views, cameras, *LOST).names == []


@pytest.mark.parametrize("period", [0, 60])
def test_a_picture_that_repeats_is_like_itself(period: int) -> None:
    picture = np.random.default_rng(0).normal(0, 0.1, (240, 240)).astype(np.float32)
    if period:
        picture = np.tile(picture[:period, :period], (4, 4))
    picture[:20] = np.nan
    likeness = anew.likeness(picture)
    assert likeness > 0.9 if period else likeness < 0.2


def test_photos_found_on_the_ground_are_lost_no_longer(tmp_path: Path) -> None:
    """A lost photo, and one far off, which keeps no sparse points that it cannot show."""
    views, cameras = capture(tmp_path, blots())
    model = right_model(cameras, lost=("IMG_07",))
    turned = cv2.Rodrigues(np.array([0.0, 0.0, 0.6]))[0]
    wrong = next(c for c in model.cameras if c.name == "IMG_00").cam_from_world.copy()
    wrong[:3, :3] = turned @ wrong[:3, :3]
    laid = laid_on_ground(views, model.placed({"IMG_00": wrong}), lambda *_: None)
    assert laid is not None
    assert set(laid.anew) == {"IMG_00", "IMG_07"}
    assert laid.model.lost == ()
    assert laid.model.names == [c.name for c in cameras]
    assert errors(laid.model, cameras).max() < 0.4
    assert len(laid.model.tracks["IMG_07"]) == 0
    assert len(laid.model.tracks["IMG_00"]) < 20 < len(laid.model.tracks["IMG_01"])
    assert ("photos placed by the ground's texture", 2) in laid.figures()


@pytest.mark.parametrize("shows", [True, False])
def test_a_photo_in_which_the_ground_is_not_found_has_no_place(tmp_path: Path, shows: bool) -> None:
    """Unless it need not show the ground: a close-up of the object does not."""
    views, cameras = capture(tmp_path, blots())
    other = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    Image.fromarray(other).save(tmp_path / "IMG_04.png")
    if not shows:
        near = replace(cameras[4], K=np.diag([8.0, 8.0, 1.0]) @ cameras[4].K)
        near.K[:2, 2] = cameras[4].K[:2, 2]
        cameras[4] = near
    laid = laid_on_ground(views, right_model(cameras), lambda *_: None)
    assert laid is not None and not laid.anew
    assert laid.denied == (("IMG_04",) if shows else ())
    assert ("IMG_04" in laid.model.names) != shows
    assert [one.name for one in laid.model.lost] == list(laid.denied)
    assert set(laid.model.tracks) == set(laid.model.lenses) == set(laid.model.names)


def test_a_picture_is_seen_from_all_round() -> None:
    """Supposed cameras stand as high and as far away as the others, and look at the object."""
    K = np.array([[400.0, 0, SIZE[0] / 2], [0, 400.0, SIZE[1] / 2], [0, 0, 1]])
    one = Camera("one", *SIZE, K, np.eye(4))
    up = np.array([0.0, 0.0, 1.0])
    others = [
        replace(one, cam_from_world=look_at(np.array([x, 0.0, z]), np.zeros(3), up))
        for x, z in ((3.0, 1.0), (2.0, 2.0), (1.0, 3.0))
    ]
    supposed = anew._supposed(one, others, np.zeros(3), up)
    assert len(supposed) == anew.AZIMUTHS * len(anew.LEVELS)
    for camera in supposed:
        pixel, depth = camera.project(np.zeros((1, 3)))
        np.testing.assert_allclose(pixel[0], np.array(SIZE) / 2, atol=1e-6)
        assert depth[0] == pytest.approx(10**0.5)
        assert camera.cam_from_world[1, 2] < 0  # upright: pictures grow downwards
