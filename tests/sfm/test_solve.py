"""The ladder: harder ways are tried only where easier ones left photos without a place."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from captures import Stages, disc, write_photos
from PIL import Image

from refdgs_pipe.artifacts.placement import Placement, Poses
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.sfm.pictures import plain_images
from refdgs_pipe.sfm.poses import Effort, Found
from refdgs_pipe.sfm.solve import solve

COUNT = 10
PLAIN = Effort(1600, 8192, 0, 1)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    folder = tmp_path_factory.mktemp("photos")
    write_photos(folder, COUNT, "png")
    return Stages(tmp_path_factory.mktemp("stages")).ingest(folder)


def poses(count: int) -> Poses:
    """So many placed photos; without evidence none of them is questioned."""
    none = np.zeros((0, 3))
    placed = {f"IMG_{i}.png": np.eye(4) for i in range(count)}
    return Poses(placed, {}, (), none, none.astype(np.uint8), {}, 0.5, "incremental")


def climbed(
    views: Views, folder: Path, counts: list[int], effort: Effort = PLAIN
) -> tuple[Placement, list[Effort]]:
    """The ladder where the rungs place so many photos, and what each was asked for."""
    left, asked = list(counts), list[Effort]()

    def run(arguments: dict[str, Any]) -> Found:
        asked.append(arguments["effort"])
        return poses(left.pop(0)), (f"note {len(asked)}",)

    found = solve(views, plain_images(views, folder), effort, masks="auto", scratch=folder, run=run)
    return found, asked


def test_a_whole_placement_ends_the_ladder(views: Views, tmp_path: Path) -> None:
    found, asked = climbed(views, tmp_path, [COUNT])
    assert len(asked) == 1 and found.attempts[0].trusted == COUNT


def test_one_lost_photo_is_worth_finer_features_and_nothing_slow(
    views: Views, tmp_path: Path
) -> None:
    found, asked = climbed(views, tmp_path, [COUNT - 1, COUNT - 1])
    assert [effort.first_octave for effort in asked] == [0, -1]
    assert [attempt.trusted for attempt in found.attempts] == [9, 9]


def test_half_lost_photos_are_worth_every_rung(views: Views, tmp_path: Path) -> None:
    found, asked = climbed(views, tmp_path, [5, 6, 8, 7])
    assert [(e.faint, e.affine) for e in asked] == [
        (False, False),
        (False, False),
        (True, False),
        (True, True),
    ]
    assert (
        found.poses is not None and len(found.poses.cam_from_world) == 8
    )  # the best, not the last
    assert found.notes == ("note 3",)


def test_where_hardly_anything_is_placed_the_slow_rung_is_not_tried(
    views: Views, tmp_path: Path
) -> None:
    found, asked = climbed(views, tmp_path, [0, 2, 2])
    assert not any(effort.affine for effort in asked) and len(found.attempts) == 3


def test_a_ground_that_repeats_places_what_features_left(
    views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("refdgs_pipe.sfm.solve.ground_repeats", lambda *a: True)
    monkeypatch.setattr("refdgs_pipe.sfm.solve.placed_by_pattern", lambda *a: poses(6))

    def run(arguments: dict[str, Any]) -> Found:
        return poses(2), ()

    pictures = plain_images(views, tmp_path)
    found = solve(views, pictures, PLAIN, masks="auto", scratch=tmp_path, run=run)
    assert found.repeats and found.poses is not None
    assert len(found.poses.cam_from_world) == 6
    assert len(found.attempts) == 2  # features mislead here: no more rungs for the other two


def test_a_pattern_that_places_less_than_features_ends_nothing(
    views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("refdgs_pipe.sfm.solve.ground_repeats", lambda *a: True)
    monkeypatch.setattr("refdgs_pipe.sfm.solve.placed_by_pattern", lambda *a: poses(4))
    places = iter([5, 6, 7, 7])
    pictures = plain_images(views, tmp_path)
    found = solve(
        views,
        pictures,
        PLAIN,
        masks="auto",
        scratch=tmp_path,
        run=lambda arguments: (poses(next(places)), ()),
    )
    assert found.poses is not None and len(found.poses.cam_from_world) == 7
    assert len(found.attempts) == 5


def test_where_the_background_stands_still_the_pattern_places_nothing(
    views: Views, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("refdgs_pipe.sfm.solve.ground_repeats", lambda *a: True)
    monkeypatch.setattr("refdgs_pipe.sfm.solve.placed_by_pattern", lambda *a: poses(COUNT))
    found, _ = climbed(views, tmp_path, [2, 2, 2])
    assert found.poses is not None and len(found.poses.cam_from_world) == 2


def test_small_photos_are_doubled_at_once_and_not_a_second_time(
    views: Views, tmp_path: Path
) -> None:
    _, asked = climbed(views, tmp_path, [8, 8, 8], Effort(1600, 8192, None, 1))
    assert [(e.first_octave, e.faint) for e in asked] == [(-1, False), (-1, True), (-1, True)]


def test_masks_add_rungs_of_their_own(tmp_path: Path) -> None:
    write_photos(tmp_path / "photos", 3, "png")
    (tmp_path / "photos" / "masks").mkdir()
    for i in range(3):
        Image.fromarray(disc()).save(tmp_path / "photos" / "masks" / f"IMG_{i}.png")
    masked = Stages(tmp_path / "stages").ingest(tmp_path / "photos")
    found, _ = climbed(masked, tmp_path / "scratch", [1, 1, 1, 3])
    assert [attempt.name for attempt in found.attempts][-1] == "features on the object only"
