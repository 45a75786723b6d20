"""Size and up from a mat in posed photos; and no size from a mat that contradicts itself."""

import numpy as np
from mat_scene import Shot, photo, ring, sighted, unseen
from scipy.spatial.transform import Rotation

from refdgs_pipe.camera import F64, Lens
from refdgs_pipe.mat.detection import Seen, seen_in
from refdgs_pipe.mat.layout import mat_of
from refdgs_pipe.sfm.frame import similarity
from refdgs_pipe.sfm.mat_frame import (
    MatFrame,
    Refused,
    Sighting,
    mat_frame,
    triangulated,
)

TURN = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
WORLD = similarity(1 / 0.137, TURN, np.array([0.5, -2.0, 1.0]))  # a unit is 0.137 m


def in_world(cam_from_mat: F64) -> F64:
    """The pose in the frame of a reconstruction of arbitrary size and direction."""
    pose = np.eye(4)
    pose[:3, :3] = cam_from_mat[:3, :3] @ TURN.T
    pose[:3, 3] = cam_from_mat[:3, 3] / 0.137 - pose[:3, :3] @ WORLD[:3, 3]
    return pose


def sighting(name: str, shot: Shot, seen: Seen) -> Sighting:
    lens = Lens(shot.K, np.array([shot.k1, 0, 0, 0, 0, 0, 0, 0]))
    return Sighting(name, lens, in_world(shot.cam_from_mat), seen)


def seen_all_round(count: int = 12, k1: float = 0.0, noise: float = 0.1) -> list[Sighting]:
    poses = [*ring(count // 2, 35), *ring(count - count // 2, 55, start=0.4)]
    shots = [unseen(pose, k1) for pose in poses]
    return [
        sighting(f"{i:02}.png", s, sighted(s, noise=noise, seed=i)) for i, s in enumerate(shots)
    ]


def checked(frame: MatFrame | Refused | None, *, size: float, up: float) -> MatFrame:
    """Relative error of the size and angle in degrees at most as given."""
    assert isinstance(frame, MatFrame)
    assert abs(frame.metres_per_unit / 0.137 - 1) < size
    assert np.degrees(np.arccos(min(1.0, float(frame.up @ TURN[:, 2])))) < up
    return frame


def test_drawn_photos_give_size_and_up() -> None:
    sightings = []
    for i, pose in enumerate([*ring(2, 35), *ring(2, 60, start=0.5)]):
        shot = photo(pose, seed=i)
        seen = seen_in(shot.grey)
        assert seen is not None
        sightings.append(sighting(f"{i}.png", shot, seen))
    frame = checked(mat_frame(sightings), size=0.001, up=0.05)
    assert frame.residual_mm < 0.15 and frame.corners > 70 and frame.elsewhere == ()


def test_noise_averages_out() -> None:
    frame = checked(mat_frame(seen_all_round(noise=0.3)), size=0.001, up=0.1)
    assert frame.photos == 12


def test_a_bent_lens_changes_nothing() -> None:
    checked(mat_frame(seen_all_round(k1=-0.2)), size=0.001, up=0.05)


def test_the_measured_line_sets_the_size() -> None:
    frame = mat_frame(seen_all_round(), line_mm=0.95 * 180)
    assert isinstance(frame, MatFrame)
    assert abs(frame.metres_per_unit / (0.95 * 0.137) - 1) < 0.001


def test_a_corner_is_triangulated_without_the_photo_that_sees_it_elsewhere() -> None:
    sightings = seen_all_round()
    corners = mat_of("a4").corners()
    number = int(sightings[0].seen.ids[0])
    sightings[0].seen.corners[0] += 40.0
    found = triangulated(sightings)
    wanted = corners[number] @ WORLD[:3, :3].T + WORLD[:3, 3]
    off = [np.linalg.norm(found[number, k] - wanted[k]) * 0.137 for k in range(4)]
    assert max(off) < 1e-3  # metres


def test_a_mat_that_was_moved_is_refused_and_said() -> None:
    sightings = seen_all_round()
    step = np.eye(4)
    step[:3, 3] = 0.04, 0.02, 0
    moved = []
    for i, s in enumerate(sightings):
        shot = unseen(ring(6, 35 if i < 6 else 55, start=0 if i < 6 else 0.4)[i % 6])
        late = Shot(shot.grey, shot.K, 0.0, shot.cam_from_mat @ step)
        moved.append(sighting(s.name, shot, sighted(late, seed=i)) if i >= 8 else s)
    answer = mat_frame(moved)
    assert isinstance(answer, Refused)
    assert "4 of 12 photos" in answer.reason and "moved" in answer.reason
    assert "08.png" in answer.reason


def test_one_photo_with_a_wrong_place_is_left_out_and_named() -> None:
    sightings = seen_all_round()
    shot = unseen(ring(6, 35)[2])
    sightings[1] = Sighting(
        "01.png", sightings[1].lens, in_world(shot.cam_from_mat), sightings[1].seen
    )
    frame = checked(mat_frame(sightings), size=0.002, up=0.1)
    assert frame.elsewhere == ("01.png",) and frame.photos == 11


def test_poses_that_fit_nothing_are_refused() -> None:
    draw = np.random.default_rng(2)
    sightings = []
    for s in seen_all_round():
        pose = s.cam_from_world.copy()
        pose[:3, 3] += draw.normal(0, 0.12, 3)
        pose[:3, :3] = Rotation.from_rotvec(draw.normal(0, 0.004, 3)).as_matrix() @ pose[:3, :3]
        sightings.append(Sighting(s.name, s.lens, pose, s.seen))
    assert not isinstance(mat_frame(sightings), MatFrame)


def test_a_bent_paper_is_refused() -> None:
    """The paper's left part stands up: corners are nowhere near the plane."""
    corners = mat_of("a4").corners()
    bent = {i: c + [0, 0, 1] * np.maximum(0, -c[:, :1] - 0.03) * 0.6 for i, c in corners.items()}
    sightings = []
    for i, s in enumerate(seen_all_round()):
        pose = ring(6, 35 if i < 6 else 55, start=0 if i < 6 else 0.4)[i % 6]
        from mat_scene import projected

        pixels = np.stack([projected(unseen(pose), bent[int(n)]) for n in s.seen.ids])
        seen = Seen("a4", s.seen.ids, pixels)
        sightings.append(Sighting(s.name, s.lens, s.cam_from_world, seen))
    assert isinstance(mat_frame(sightings), Refused)


def test_too_little_of_a_mat_says_nothing() -> None:
    sightings = seen_all_round()
    assert mat_frame([]) is None
    assert mat_frame(sightings[:1]) is None  # one photo: nothing can be triangulated


def test_two_kinds_of_mat_are_refused() -> None:
    sightings = seen_all_round()
    s = sightings[0].seen
    other = Sighting(
        "x", sightings[0].lens, sightings[0].cam_from_world, Seen("letter", s.ids + 60, s.corners)
    )
    assert isinstance(mat_frame([*sightings, other]), Refused)
