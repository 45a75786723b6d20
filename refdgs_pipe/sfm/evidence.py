"""What the database and the reconstruction say about each photo's place. Child process only."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from refdgs_pipe.artifacts.placement import Evidence, Poses
from refdgs_pipe.camera import F64, center_of
from refdgs_pipe.sfm.again import Sights, moves

HELD_EVERY = 8
HELD_MATCHES = 30  # verified matches of a pair that is worth holding out
PARTNERS_LEFT = 6
AGREES = 0.0025  # of the long side: as far as a match may lie from its epipolar line
FLAT_DEG = 0.5  # below this angle between rays their depth has no sign


@dataclass(frozen=True)
class Known:
    """What is known before mapping.

    Args:
        still: (n,) for the photos by name, the share of matches that stand still.
        held: pairs of rows of these photos that the mapper does not get.
    """

    still: F64
    held: frozenset[tuple[int, int]]


def hold_out(database: Path) -> frozenset[tuple[int, int]]:
    """Delete the geometry of some pairs that the mapper can do without, and return their rows.

    Every eighth well matched pair of photos that have six other partners each. The places that
    are found without them are held against them afterwards.
    """
    with pycolmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        count: dict[tuple[int, int], int] = {}
        for a, one in enumerate(images):
            for b in range(a + 1, len(images)):
                pair = (one.image_id, images[b].image_id)
                if db.exists_two_view_geometry(*pair):
                    found = len(db.read_two_view_geometry(*pair).inlier_matches)
                    if found >= HELD_MATCHES:
                        count[a, b] = found
        partners = np.zeros(len(images), np.int64)
        for a, b in count:
            partners[[a, b]] += 1
        held = set()
        for a, b in list(count)[HELD_EVERY // 2 :: HELD_EVERY]:
            if min(partners[a], partners[b]) > PARTNERS_LEFT:
                partners[[a, b]] -= 1
                db.delete_two_view_geometry(images[a].image_id, images[b].image_id)
                held.add((a, b))
    return frozenset(held)


def poses_of(model: Any, mapper: str, database: Path, known: Known) -> Poses:
    """A reconstruction as arrays, with its evidence; None gives no places, but what was matched.

    Args:
        database: with all pairs, also those that were held out.
    """
    model = pycolmap.Reconstruction() if model is None else model
    found = arrays_of(model, mapper)
    evidence = evidence_of(model, database, known, found.cam_from_world, found.tracks, found.points)
    return replace(found, evidence=evidence)


def arrays_of(model: Any, mapper: str) -> Poses:
    """A reconstruction as arrays, without evidence."""
    point_ids = sorted(model.point3D_ids())
    index = {point_id: i for i, point_id in enumerate(point_ids)}
    images = sorted((model.image(i) for i in model.reg_image_ids()), key=lambda image: image.name)
    camera_ids = sorted({image.camera_id for image in images})
    lenses = []
    for camera in (model.camera(i) for i in camera_ids):
        params = np.array(camera.params, float)
        lenses.append((str(camera.model.name), camera.width, camera.height, params))
    poses, tracks = {}, {}
    for image in images:
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        poses[image.name] = pose
        seen = {index[p.point3D_id] for p in image.points2D if p.has_point3D()}
        tracks[image.name] = np.array(sorted(seen), np.int64)
    points = [model.point3D(i) for i in point_ids]
    xyz = np.array([point.xyz for point in points], float).reshape(-1, 3)
    return Poses(
        cam_from_world=poses,
        lens_of={image.name: camera_ids.index(image.camera_id) for image in images},
        lenses=tuple(lenses),
        points=xyz,
        colors=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        tracks=tracks,
        error_px=float(model.compute_mean_reprojection_error()) if point_ids else 0.0,
        mapper=mapper,
    )


def evidence_of(
    model: Any,
    database: Path,
    known: Known,
    poses: dict[str, F64],
    tracks: dict[str, NDArray[np.int64]],
    points: F64,
) -> Evidence:
    """Compare every verified pair with the places that were found.

    The mapper builds on some pairs and gives up others that contradict them; here all of them
    are held against the result.
    """
    placed = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    with pycolmap.Database.open(database) as db:
        images = sorted(db.read_all_images(), key=lambda image: image.name)
        found = [db.num_keypoints_for_image(image.image_id) for image in images]
        rows, matches, inliers, agree = [], [], [], []
        rays = {
            row: _rays(model, placed[image.name], db.read_keypoints(image.image_id))
            for row, image in enumerate(images)
            if image.name in placed
        }
        for a, one in enumerate(images):
            for b in range(a + 1, len(images)):
                pair = (one.image_id, images[b].image_id)
                if not db.exists_matches(*pair):
                    continue
                rows.append((a, b))
                matches.append(len(db.read_matches(*pair)))
                kept = np.zeros((0, 2), np.int64)
                if db.exists_two_view_geometry(*pair):
                    geometry = db.read_two_view_geometry(*pair)
                    kept = np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2)
                inliers.append(len(kept))
                share = float("nan")
                if a in rays and b in rays and len(kept):
                    first, second = poses[one.name], poses[images[b].name]
                    share = _agreement(rays[a], rays[b], kept, second @ np.linalg.inv(first))
                agree.append(share)
    names = tuple(image.name for image in images)
    pairs = np.array(rows, np.int32).reshape(-1, 2)
    shared, angle = _shared(names, pairs, poses, tracks, points)
    return Evidence(
        names=names,
        features=np.array(found, np.int32),
        still=known.still,
        moves=_moves(model, placed, names, poses, points),
        held=np.array([pair in known.held for pair in rows], bool),
        pairs=pairs,
        matches=np.array(matches, np.int32),
        inliers=np.array(inliers, np.int32),
        agree=np.array(agree, float),
        shared=shared,
        angle=angle,
    )


def _moves(
    model: Any, placed: dict[str, Any], names: tuple[str, ...], poses: dict[str, F64], points: F64
) -> F64:
    """(n,) how far the others move each photo (again.py); NaN for photos without a place.

    Args:
        placed: file name -> COLMAP's image, for the files of `poses`.
    """
    out = np.full(len(names), np.nan)
    index = {point_id: i for i, point_id in enumerate(sorted(model.point3D_ids()))}
    photo, point, rays, pixel = [], [], [np.zeros((0, 2))], []
    for k, file in enumerate(poses):
        camera = model.camera(placed[file].camera_id)
        seen = [p for p in placed[file].points2D if p.has_point3D()]
        xy = np.array([p.xy for p in seen], float).reshape(-1, 2)
        rays.append(np.asarray(camera.cam_from_img(xy), float).reshape(-1, 2))
        photo += [k] * len(seen)
        point += [index[p.point3D_id] for p in seen]
        pixel.append(1 / camera.mean_focal_length())
    if poses:
        sights = Sights(np.array(photo, int), np.array(point, int), np.concatenate(rays))
        where = np.array([names.index(file) for file in poses])
        out[where] = moves(np.stack(list(poses.values())), points, sights, np.array(pixel))
    return out


def _rays(model: Any, image: Any, keypoints: Any) -> tuple[F64, float]:
    """(n, 3) rays with z = 1 in the photo's camera, and the tolerance at that length."""
    camera = model.camera(image.camera_id)
    xy = np.asarray(keypoints, float)[:, :2].reshape(-1, 2)
    flat = np.asarray(camera.cam_from_img(xy), float).reshape(-1, 2)
    focal = float(camera.mean_focal_length())
    rays = np.concatenate([flat, np.ones((len(flat), 1))], 1)
    return rays, AGREES * max(camera.width, camera.height) / focal


def _agreement(
    a: tuple[F64, float], b: tuple[F64, float], kept: NDArray[np.int64], b_from_a: F64
) -> float:
    """Share of the matches that lie near their epipolar lines and before both cameras.

    Sampson's distance (Hartley and Zisserman 2004, 11.4.3), in units of the image at z = 1.
    """
    one, two = a[0][kept[:, 0]], b[0][kept[:, 1]]
    R, t = b_from_a[:3, :3], b_from_a[:3, 3]
    length = float(np.linalg.norm(t))
    if length < 1e-12:
        return float("nan")
    x, y, z = t / length
    E = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ R
    line_b, line_a = one @ E.T, two @ E
    off = np.abs((two * line_b).sum(1))
    slope = np.sqrt((line_b[:, :2] ** 2).sum(1) + (line_a[:, :2] ** 2).sum(1))
    near = off / np.maximum(slope, 1e-12) < max(a[1], b[1])
    away = one @ R.T  # the first ray in the second camera
    along = (away * two).sum(1)
    aa, bb = (away**2).sum(1), (two**2).sum(1)
    square = aa * bb - along**2
    depth_a = -(bb * (away @ t) - along * (two @ t)) / np.maximum(square, 1e-15)
    depth_b = (aa * (two @ t) - along * (away @ t)) / np.maximum(square, 1e-15)
    flat = square < np.sin(np.radians(FLAT_DEG)) ** 2 * aa * bb
    return float((near & (flat | ((depth_a > 0) & (depth_b > 0)))).mean())


def _shared(
    names: tuple[str, ...],
    pairs: NDArray[np.int32],
    poses: dict[str, F64],
    tracks: dict[str, NDArray[np.int64]],
    points: F64,
) -> tuple[NDArray[np.int32], F64]:
    """For each pair the points that both see, and the median angle between their rays."""
    counts = np.zeros(len(pairs), np.int32)
    angles = np.full(len(pairs), np.nan)
    for k, (a, b) in enumerate(pairs):
        one, two = names[a], names[b]
        if one not in poses or two not in poses:
            continue
        both = np.intersect1d(tracks[one], tracks[two], assume_unique=True)
        counts[k] = len(both)
        if len(both):
            rays = [points[both] - center_of(poses[name]) for name in (one, two)]
            cosine = (rays[0] * rays[1]).sum(1) / np.maximum(
                np.linalg.norm(rays[0], axis=1) * np.linalg.norm(rays[1], axis=1), 1e-12
            )
            angles[k] = np.degrees(np.median(np.arccos(np.clip(cosine, -1, 1))))
    return counts, angles
