"""Photos placed by the mat alone, and photos that features lost placed in what is there."""

from dataclasses import replace

import numpy as np
import pytest
from mat_scene import FOCAL, SIZE, looking_at, photo, ring, sighted, unseen
from scipy.spatial.transform import Rotation

from refdgs_pipe.camera import F64
from refdgs_pipe.mat.detection import Seen, seen_in
from refdgs_pipe.sfm.mat_pose import found_by_mat, placed_by_mat
from refdgs_pipe.sfm.poses import Poses, Shots

ALL_ROUND = [*ring(5, 30), *ring(5, 55, start=0.4)]


def seen_all_round(k1: float = 0.0, noise: float = 0.1) -> dict[str, Seen]:
    return {
        f"{i:02}.png": sighted(unseen(pose, k1), noise=noise, seed=i)
        for i, pose in enumerate(ALL_ROUND)
    }


def one_lens(files: dict[str, Seen], focal: float | None) -> tuple[Shots, ...]:
    return (Shots(tuple(sorted(files)), *SIZE, focal),)


def center(pose: F64) -> F64:
    return np.asarray(-pose[:3, :3].T @ pose[:3, 3])


def worst_center(poses: Poses) -> float:
    """Metres between the cameras and the true ones, at worst."""
    return max(
        float(np.linalg.norm(center(pose) - center(ALL_ROUND[int(file[:2])])))
        for file, pose in poses.cam_from_world.items()
    )


@pytest.mark.parametrize("focal", [None, 1.06 * FOCAL])
def test_the_mat_alone_places_all_photos(focal: float | None) -> None:
    files = seen_all_round()
    poses = placed_by_mat(files, one_lens(files, focal))
    assert poses is not None and set(poses.cam_from_world) == set(files)
    assert poses.mapper == "mat" and poses.error_px < 0.2
    assert abs(poses.lenses[0][3][0] / FOCAL - 1) < 0.005
    assert worst_center(poses) < 0.003  # of 0.45 m


def test_the_lens_distortion_is_found() -> None:
    files = seen_all_round(k1=-0.12)
    poses = placed_by_mat(files, one_lens(files, FOCAL))
    assert poses is not None and abs(poses.lenses[0][3][3] + 0.12) < 0.02
    assert worst_center(poses) < 0.004


def test_drawn_photos_are_placed() -> None:
    seen = {f"{i:02}.png": seen_in(photo(pose).grey) for i, pose in enumerate(ALL_ROUND[3:7], 3)}
    files = {name: found for name, found in seen.items() if found is not None}
    poses = placed_by_mat(files, one_lens(files, FOCAL))
    assert poses is not None and len(poses.cam_from_world) == 4
    assert worst_center(poses) < 0.003


def test_points_and_tracks_are_what_the_photos_see() -> None:
    files = seen_all_round()
    poses = placed_by_mat(files, one_lens(files, FOCAL))
    assert poses is not None
    assert np.allclose(poses.points[:, 2], 0) and len(poses.points) == len(poses.colors)
    for file, seen in files.items():
        pose = poses.cam_from_world[file]
        ahead = poses.points[poses.tracks[file]] @ pose[:3, :3].T + pose[:3, 3]
        K = unseen(ALL_ROUND[0]).K
        pixels = (ahead @ K.T)[:, :2] / ahead[:, 2:]
        assert np.abs(pixels - seen.pixels()).max() < 2.0


def test_two_lenses_stay_two_and_photos_with_few_markers_are_left_out() -> None:
    files = seen_all_round()
    few = Seen("a4", files["09.png"].ids[:2], files["09.png"].corners[:2])
    files["09.png"] = few
    names = sorted(files)
    shots = (Shots(tuple(names[:5]), *SIZE, FOCAL), Shots(tuple(names[5:]), *SIZE, FOCAL))
    poses = placed_by_mat(files, shots)
    assert poses is not None and len(poses.lenses) == 2
    assert set(poses.cam_from_world) == set(names) - {"09.png"}


def test_a_photo_whose_markers_fit_no_place_is_left_out() -> None:
    files = seen_all_round()
    draw = np.random.default_rng(1)
    spoilt = files["04.png"]
    files["04.png"] = replace(spoilt, corners=spoilt.corners + draw.normal(0, 15, (1, 4, 2)))
    poses = placed_by_mat(files, one_lens(files, FOCAL))
    assert poses is not None and set(poses.cam_from_world) == set(files) - {"04.png"}


def test_no_mat_or_too_few_photos_place_nothing() -> None:
    assert placed_by_mat({}, (Shots(("a.png",), *SIZE, None),)) is None
    files = dict(list(seen_all_round().items())[:2])
    assert placed_by_mat(files, one_lens(files, FOCAL)) is None


def test_seen_straight_from_above_the_focal_length_of_exif_is_kept() -> None:
    """Parallel to the mat a photo cannot tell distance from focal length."""
    poses = [looking_at((0.002 * i, 0.001, 0.4)) for i in range(4)]
    files = {f"{i}.png": sighted(unseen(pose), seed=i) for i, pose in enumerate(poses)}
    found = placed_by_mat(files, one_lens(files, FOCAL))
    assert found is not None and abs(found.lenses[0][3][0] / FOCAL - 1) < 0.05


def moved_poses(files: dict[str, Seen], placed: list[str]) -> tuple[Poses, F64]:
    """What features placed, in a frame and unit of their own."""
    turn = Rotation.from_rotvec([0.2, 0.5, -1.0]).as_matrix()
    shift, scale = np.array([1.0, 2.0, -0.5]), 3.7
    poses = {}
    for file in files:
        here = ALL_ROUND[int(file[:2])]
        pose = np.eye(4)
        pose[:3, :3] = here[:3, :3] @ turn.T
        pose[:3, 3] = scale * here[:3, 3] - pose[:3, :3] @ shift
        poses[file] = pose
    lens = ("OPENCV", *SIZE, np.array([FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, 0, 0, 0, 0.0]))
    known = Poses(
        {file: poses[file] for file in placed},
        dict.fromkeys(placed, 0),
        (lens,),
        np.ones((5, 3)),
        np.zeros((5, 3), np.uint8),
        {file: np.arange(5) for file in placed},
        0.4,
        "incremental",
    )
    return known, poses  # type: ignore[return-value]


def test_photos_that_features_lost_are_placed_in_the_frame_that_is_there() -> None:
    files = seen_all_round()
    names = sorted(files)
    known, truth = moved_poses(files, names[:6])
    both = found_by_mat(known, files, one_lens(files, FOCAL))
    assert set(both.cam_from_world) == set(names)
    for file in names:
        off = np.linalg.norm(center(both.cam_from_world[file]) - center(truth[file]))  # type: ignore[call-overload]
        assert off < 0.01 * 3.7 * 0.45
    assert all(np.array_equal(both.cam_from_world[f], known.cam_from_world[f]) for f in names[:6])
    assert (both.tracks[names[8]] >= 5).all() and both.tracks[names[8]].max() < len(both.points)


def test_lost_photos_of_another_lens_need_its_exif() -> None:
    files = seen_all_round()
    names = sorted(files)
    known, _ = moved_poses(files, names[:6])
    blind = (Shots(tuple(names[:6]), *SIZE, FOCAL), Shots(tuple(names[6:]), *SIZE, None))
    assert found_by_mat(known, files, blind) is known
    told = (Shots(tuple(names[:6]), *SIZE, FOCAL), Shots(tuple(names[6:]), *SIZE, FOCAL))
    both = found_by_mat(known, files, told)
    assert set(both.cam_from_world) == set(names) and len(both.lenses) == 2


def test_nothing_is_added_where_the_placed_photos_do_not_see_the_mat() -> None:
    files = seen_all_round()
    names = sorted(files)
    known, _ = moved_poses(files, names[:6])
    late = {file: files[file] for file in names[6:]}
    assert found_by_mat(known, late, one_lens(files, FOCAL)) is known
