"""Markers in photos: found to a fraction of a pixel, half hidden, linear; none without a mat."""

from pathlib import Path

import cv2
import numpy as np
from mat_scene import looking_at, photo, projected, ring

from refdgs_pipe.files.images import write_png
from refdgs_pipe.mat.detection import eight_bit_grey, seen_in, seen_in_files
from refdgs_pipe.mat.layout import mat_of

CORNERS = mat_of("a4").corners()


def test_corners_are_found_to_a_tenth_of_a_pixel() -> None:
    for pose in ring(3, 45, start=0.3):
        shot = photo(pose)
        seen = seen_in(shot.grey)
        assert seen is not None and seen.paper == "a4" and len(seen.ids) >= 18
        off = seen.pixels() - projected(shot, seen.on_mat(CORNERS))
        assert np.sqrt((off**2).mean()) < 0.1 and np.abs(off.mean(axis=0)).max() < 0.03  # no shift


def test_the_lens_may_bend_the_picture() -> None:
    shot = photo(ring(1, 50)[0], k1=-0.15)
    seen = seen_in(shot.grey)
    assert seen is not None and len(seen.ids) >= 18
    assert np.abs(seen.pixels() - projected(shot, seen.on_mat(CORNERS))).max() < 0.5


def test_letter_paper_is_known_by_its_ids() -> None:
    seen = seen_in(photo(ring(1, 50)[0], paper="letter").grey)
    assert seen is not None and seen.paper == "letter"


def test_what_is_half_hidden_is_still_found() -> None:
    shot = photo(ring(1, 50)[0])
    grey = shot.grey.copy()
    cv2.ellipse(grey, (320, 240), (170, 130), 0, 0, 360, 90, -1)
    grey[:, :150] = 60
    seen = seen_in(grey)
    assert seen is not None and 2 <= len(seen.ids) <= 15
    assert np.abs(seen.pixels() - projected(shot, seen.on_mat(CORNERS))).max() < 0.5


def test_a_marker_that_is_there_twice_or_in_the_wrong_place_does_not_count() -> None:
    grey = photo(looking_at((0.01, -0.01, 0.45))).grey
    seen = seen_in(grey)
    assert seen is not None
    first = seen.corners[0]
    x, y = first.min(axis=0).astype(int) - 6
    x1, y1 = first.max(axis=0).astype(int) + 6
    twice = grey.copy()
    patch = grey[y:y1, x:x1]
    twice[200 : 200 + patch.shape[0], 300 : 300 + patch.shape[1]] = patch
    again = seen_in(twice)
    assert again is not None and seen.ids[0] not in again.ids and len(again.ids) >= 15
    moved = twice.copy()
    moved[y:y1, x:x1] = 255
    once = seen_in(moved)
    assert once is not None and seen.ids[0] not in once.ids


def test_no_mat_no_markers() -> None:
    noise = np.random.default_rng(3).integers(0, 255, (480, 640), np.uint8)
    assert seen_in(noise) is None
    assert seen_in(np.full((480, 640), 128, np.uint8)) is None
    assert seen_in(np.zeros((1, 1), np.uint8)) is None
    rough = cv2.resize(noise[:60, :80], (640, 480), interpolation=cv2.INTER_NEAREST)
    assert seen_in(np.asarray(rough, np.uint8)) is None


def test_linear_sixteen_bit_photos_are_read(tmp_path: Path) -> None:
    grey = photo(ring(1, 50)[0]).grey
    linear = np.round((grey.astype(float) / 255) ** 2.2 * 0.2 * 65535).astype(np.uint16)
    write_png(tmp_path / "a.png", np.repeat(linear[..., None], 3, axis=2))
    write_png(tmp_path / "b.png", np.full((50, 60, 3), 900, np.uint16))
    seen = seen_in_files(tmp_path, ["b.png", "a.png"], threads=1, color_space="linear")
    assert list(seen) == ["a.png"] and len(seen["a.png"].ids) >= 18
    assert eight_bit_grey(linear, "linear").dtype == np.uint8
