"""Photos placed by the mat that they show: all of them, or those that features could not place."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from refdgs_pipe.camera import F64, Lens
from refdgs_pipe.files.colmap import opencv_lens
from refdgs_pipe.mat.detection import Seen
from refdgs_pipe.mat.layout import LINE_MM, mat_of
from refdgs_pipe.sfm.mat_frame import MatFrame, mat_frame, shown, sightings_in_poses
from refdgs_pipe.sfm.poses import Poses, Shots

LEAST_MARKERS = 3  # in a photo that nothing else places
LEAST_PHOTOS = 3
WORST_PX = 2.0  # median distance of corners, by 1000 px of focal length
FOCAL_SPREAD = 0.05  # how far EXIF's focal length may be off, relative, one sigma
WITHOUT_EXIF = 1.2  # first guess of the focal length by the long side
FOCAL_RANGE = (0.4, 8.0)  # by the long side
PHOTOS_FOR_BENDING = 6  # with fewer the lens is taken to be without distortion


@dataclass(frozen=True)
class _Group:
    """Photos through one lens, with their poses on the mat as they are being found."""

    shots: Shots
    files: tuple[str, ...]
    seen: tuple[Seen, ...]


def placed_by_mat(
    detections: dict[str, Seen], shots: tuple[Shots, ...], *, line_mm: float = LINE_MM
) -> Poses | None:
    """Place photos by the mat alone, in metres: origin in its middle, z up.

    Each photo is posed by the plane of the corners, then poses, focal length and one term of radial
    distortion of each lens are adjusted together so that the corners' pixels fit best.

    Args:
        detections: file name -> the markers in it.
        line_mm: the ruler line's length as measured on the printed sheet.

    Returns:
        Poses whose points are the mat's corners; None if fewer than three photos could be placed.
    """
    papers = [seen.paper for seen in detections.values()]
    if not papers:
        return None
    paper = max(sorted(set(papers)), key=papers.count)
    corners = mat_of(paper, line_mm=line_mm).corners()
    solved = []
    for group in shots:
        files = [f for f in group.files if f in detections]
        usable = [f for f in files if _is_enough(detections[f]) and detections[f].paper == paper]
        if usable:
            found = tuple(detections[f] for f in usable)
            solved.append(_solved(_Group(group, tuple(usable), found), corners))
    return _as_poses(solved, detections, corners)


def posed_on_plane(seen: dict[str, Seen], shots: Shots, corners: dict[int, F64]) -> Poses | None:
    """Place photos of one lens by points of a plane; None if fewer than three could be placed.

    Args:
        seen: file name -> the points in it, as markers of one corner or more.
        corners: id -> (k, 3) where they are, z = 0.
    """
    files = tuple(file for file in shots.files if file in seen and len(seen[file].ids) >= 4)
    if not files:
        return None
    group = _Group(shots, files, tuple(seen[file] for file in files))
    poses = _as_poses([_solved(group, corners)], seen, corners)
    return None if poses is None else replace(poses, mapper="pattern")


def found_by_mat(
    poses: Poses,
    detections: dict[str, Seen],
    shots: tuple[Shots, ...],
    *,
    line_mm: float = LINE_MM,
) -> Poses:
    """Add the photos that features could not place but that show the mat.

    The mat's place comes from the photos that are placed; where these do not agree on one, or too
    few see it, nothing is added. The frame of `poses` stays.
    """
    lost = sorted(set(detections) - set(poses.cam_from_world))
    frame = mat_frame(sightings_in_poses(poses, detections), line_mm=line_mm) if lost else None
    if not isinstance(frame, MatFrame):
        return poses
    known = detections[next(f for f in sorted(detections) if f in poses.cam_from_world)].paper
    corners = mat_of(known, line_mm=line_mm).corners()
    world = frame.world_from_mat
    lenses = list(poses.lenses)
    placed, lens_of = dict(poses.cam_from_world), dict(poses.lens_of)
    new = []
    for file in lost:
        seen = detections[file]
        index = _lens_for(file, shots, poses, lenses)
        if index is None or seen.paper != known or not _is_enough(seen):
            continue
        lens = Lens(*opencv_lens(lenses[index][0], lenses[index][3]))
        pose = _posed(seen, corners, lens)
        if pose is not None and _misses(seen, corners, pose, lens) < _limit(lens):
            placed[file], lens_of[file] = _in_world(pose, world), index
            new.append(file)
    if not new:
        return poses
    points, colors, tracks = _corner_points({f: detections[f] for f in new}, corners)
    points = points @ world[:3, :3].T + world[:3, 3]
    moved = {file: ids + len(poses.points) for file, ids in tracks.items()}
    return replace(
        poses,
        cam_from_world=placed,
        lens_of=lens_of,
        lenses=tuple(lenses),
        points=np.concatenate([poses.points, points]),
        colors=np.concatenate([poses.colors, colors]),
        tracks=poses.tracks | moved,
        by_mat=tuple(new),
    )


def _is_enough(seen: Seen) -> bool:
    return len(seen.ids) >= LEAST_MARKERS


def _limit(lens: Lens) -> float:
    return WORST_PX * max(1.0, float(lens.K[0, 0]) / 1000)


def _posed(seen: Seen, corners: dict[int, F64], lens: Lens) -> F64 | None:
    """cam_from_mat (4, 4) of one photo; None if nothing fits.

    A plane seen from afar fits two poses. The better one is taken, after both were polished.
    """
    points, pixels = seen.on_mat(corners), seen.pixels()
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        points, pixels, lens.K, lens.distortion, flags=cv2.SOLVEPNP_IPPE
    )
    candidates: list[tuple[float, int, F64]] = []
    for turn, shift in zip(turns, shifts, strict=True) if found else ():
        turn, shift = cv2.solvePnPRefineLM(points, pixels, lens.K, lens.distortion, turn, shift)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
        above = -pose[:3, :3].T @ pose[:3, 3]
        if np.isfinite(pose).all() and above[2] > 0:
            candidates.append((_misses(seen, corners, pose, lens), len(candidates), pose))
    return min(candidates)[2] if candidates else None


def _misses(seen: Seen, corners: dict[int, F64], pose: F64, lens: Lens) -> float:
    """Median distance of the corners from where the pose shows them, pixels."""
    off = shown(seen.on_mat(corners), pose, lens) - seen.pixels()
    return float(np.median(np.linalg.norm(off, axis=1)))


def _plain_lens(shots: Shots, focal: float, k1: float = 0.0) -> Lens:
    K = np.array([[focal, 0, shots.width / 2], [0, focal, shots.height / 2], [0, 0, 1.0]])
    return Lens(K, np.array([k1, 0, 0, 0, 0, 0, 0, 0]))


def _solved(group: _Group, corners: dict[int, F64]) -> tuple[_Group, Lens, dict[str, F64]]:
    """The lens of a group and cam_from_mat of those of its photos that fit."""
    long = max(group.shots.width, group.shots.height)
    guesses = [group.shots.focal] if group.shots.focal else [k * long for k in (0.7, 1.2, 2.2)]
    best: tuple[float, Lens, dict[str, F64]] | None = None
    for guess in guesses:
        lens, poses = _adjusted(group, corners, _plain_lens(group.shots, guess))
        if poses:
            seen = dict(zip(group.files, group.seen, strict=True))
            off = [_misses(seen[file], corners, pose, lens) for file, pose in poses.items()]
            figure = float(np.mean(off)) - 0.1 * len(poses)
            if best is None or figure < best[0]:
                best = figure, lens, poses
    if best is None:
        return group, _plain_lens(group.shots, guesses[0]), {}
    return group, best[1], best[2]


def _adjusted(group: _Group, corners: dict[int, F64], lens: Lens) -> tuple[Lens, dict[str, F64]]:
    """Pose each photo, then adjust all poses and the lens together; photos that do not fit go."""
    poses = {
        file: pose
        for file, seen in zip(group.files, group.seen, strict=True)
        if (pose := _posed(seen, corners, lens)) is not None
    }
    seen_in = dict(zip(group.files, group.seen, strict=True))
    for _ in range(3):
        if not poses:
            return lens, {}
        lens, poses = _bundled(group.shots, {f: seen_in[f] for f in poses}, corners, lens, poses)
        again = {f: _posed(seen_in[f], corners, lens) for f in poses}  # the other of the two poses
        better = {
            file: pose
            for file, pose in again.items()
            if pose is not None
            and _misses(seen_in[file], corners, pose, lens)
            < 0.7 * _misses(seen_in[file], corners, poses[file], lens)
        }
        poses |= better
        good = {
            f: p for f, p in poses.items() if _misses(seen_in[f], corners, p, lens) < _limit(lens)
        }
        if len(good) == len(poses) and not better:
            break
        poses = good
    return lens, poses


def _bundled(
    shots: Shots, seen: dict[str, Seen], corners: dict[int, F64], lens: Lens, poses: dict[str, F64]
) -> tuple[Lens, dict[str, F64]]:
    """Least squares over the poses, the focal length and k1 (Triggs et al. 1999), robust."""
    from scipy.optimize import least_squares
    from scipy.sparse import lil_matrix
    from scipy.spatial.transform import Rotation

    files, long = list(poses), max(shots.width, shots.height)
    bends = len(files) >= PHOTOS_FOR_BENDING
    focal = float(lens.K[0, 0])
    counts = [2 * len(seen[file].pixels()) for file in files]

    def lens_at(x: F64) -> Lens:
        low, high = (share * long for share in FOCAL_RANGE)
        wanted = float(np.clip(focal * np.exp(x[0]), low, high))
        return _plain_lens(shots, wanted, float(lens.distortion[0] + x[1]) if bends else 0.0)

    def pose_at(x: F64, i: int) -> F64:
        step = x[2 + 6 * i : 8 + 6 * i]
        pose = poses[files[i]].copy()
        pose[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += step[3:] * np.linalg.norm(pose[:3, 3])
        return pose

    def miss(x: F64) -> F64:
        here = lens_at(x)
        off = [
            (shown(seen[f].on_mat(corners), pose_at(x, i), here) - seen[f].pixels()).ravel()
            for i, f in enumerate(files)
        ]
        prior = np.log(here.K[0, 0] / shots.focal) / FOCAL_SPREAD if shots.focal else 0.0
        return np.concatenate([*off, [prior, 1e-3 * x[1]]])

    pattern = lil_matrix((sum(counts) + 2, 2 + 6 * len(files)), dtype=np.int8)
    pattern[:, :2] = 1
    for i, row in enumerate(np.cumsum([0, *counts[:-1]])):
        pattern[row : row + counts[i], 2 + 6 * i : 8 + 6 * i] = 1
    found = least_squares(
        miss,
        np.zeros(2 + 6 * len(files)),
        jac_sparsity=pattern,
        loss="soft_l1",
        f_scale=0.5,
        max_nfev=30,
    )
    return lens_at(found.x), {f: pose_at(found.x, i) for i, f in enumerate(files)}


def _as_poses(
    solved: list[tuple[_Group, Lens, dict[str, F64]]],
    detections: dict[str, Seen],
    corners: dict[int, F64],
) -> Poses | None:
    placed: dict[str, F64] = {}
    lens_of: dict[str, int] = {}
    lenses: list[tuple[str, int, int, F64]] = []
    errors: list[float] = []
    for group, lens, poses in solved:
        if not poses:
            continue
        for file, pose in poses.items():
            placed[file], lens_of[file] = pose, len(lenses)
            errors.append(_misses(detections[file], corners, pose, lens))
        parameters = np.array([*lens.K[[0, 0, 1], [0, 2, 2]], lens.distortion[0]])
        lenses.append(("SIMPLE_RADIAL", group.shots.width, group.shots.height, parameters))
    if len(placed) < LEAST_PHOTOS:
        return None
    points, colors, tracks = _corner_points({f: detections[f] for f in placed}, corners)
    error = float(np.mean(errors))
    return Poses(placed, lens_of, tuple(lenses), points, colors, tracks, error, "mat")


def _corner_points(
    seen: dict[str, Seen], corners: dict[int, F64]
) -> tuple[F64, np.ndarray[tuple[int, ...], np.dtype[np.uint8]], dict[str, np.ndarray]]:
    """The corners that are seen, on the mat; black; and which of them each photo sees."""
    ids = sorted({int(i) for found in seen.values() for i in found.ids})
    each = len(corners[ids[0]])
    first = {marker: each * row for row, marker in enumerate(ids)}
    points = np.concatenate([corners[marker] for marker in ids])
    tracks = {
        file: np.concatenate([first[int(i)] + np.arange(each) for i in found.ids]).astype(np.int64)
        for file, found in seen.items()
    }
    return points, np.zeros((len(points), 3), np.uint8), tracks


def _in_world(cam_from_mat: F64, world: F64) -> F64:
    """cam_from_world (rigid, the world's unit) of a camera posed on a mat that lies at `world`."""
    scale = float(np.cbrt(np.linalg.det(world[:3, :3])))
    pose = np.eye(4)
    pose[:3, :3] = cam_from_mat[:3, :3] @ (world[:3, :3] / scale).T
    pose[:3, 3] = scale * cam_from_mat[:3, 3] - pose[:3, :3] @ world[:3, 3]
    return pose


def _lens_for(
    file: str, shots: tuple[Shots, ...], poses: Poses, lenses: list[tuple[str, int, int, F64]]
) -> int | None:
    """Index of the lens of a photo: that of its group, or a new one from EXIF; None if unknown."""
    group = next((g for g in shots if file in g.files), None)
    if group is None:
        return None
    shared = [poses.lens_of[f] for f in group.files if f in poses.lens_of]
    if shared:
        return max(sorted(set(shared)), key=shared.count)
    if group.focal is None:
        return None
    plain = np.array([group.focal, group.width / 2, group.height / 2, 0.0])
    for index, (name, width, height, parameters) in enumerate(lenses[len(poses.lenses) :]):
        if (name, width, height) == ("SIMPLE_RADIAL", group.width, group.height) and np.array_equal(
            parameters, plain
        ):
            return len(poses.lenses) + index
    lenses.append(("SIMPLE_RADIAL", group.width, group.height, plain))
    return len(lenses) - 1
