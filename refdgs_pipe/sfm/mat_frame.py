"""Metres and up from a mat in posed photos."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from refdgs_pipe.camera import F64, Lens
from refdgs_pipe.files.colmap import opencv_lens
from refdgs_pipe.mat.detection import Seen
from refdgs_pipe.mat.layout import LINE_MM, mat_of
from refdgs_pipe.sfm.frame import similarity
from refdgs_pipe.sfm.poses import Poses

LEAST_CORNERS = 8  # triangulated, of at least two markers
LEAST_ANGLE = np.radians(2.0)  # between the rays that a corner is triangulated from
FAR_PX = 3.0  # off by more, a corner is not where the mat has it; at 1000 px of focal length
WRONG_SHARE = 0.5  # of a photo's corners: then the photo shows the mat in another place
MOVED_SHARE = 0.1  # of the photos: then the mat was moved
WORST = 0.01  # residual as a part of the mat's width: no mat of ours, crumpled, or wrong poses


@dataclass(frozen=True)
class Sighting:
    """A posed photo that shows the mat.

    Args:
        cam_from_world: (4, 4), rigid, in the frame and unit of the reconstruction.
    """

    name: str
    lens: Lens
    cam_from_world: F64
    seen: Seen


@dataclass(frozen=True)
class MatFrame:
    """Where the mat lies in a reconstruction.

    Args:
        metres_per_unit: of the reconstruction.
        up: (3,) the mat's normal, unit length, in the reconstruction's frame.
        world_from_mat: (4, 4) similarity from metres on the mat to the reconstruction.
        residual_mm: root of the mean square distance of triangulated corners to the mat's own.
        residual_percent: the same by the mat's width.
        corners, photos: how many were used.
        elsewhere: photos that show the mat in another place.
    """

    metres_per_unit: float
    up: F64
    world_from_mat: F64
    residual_mm: float
    residual_percent: float
    corners: int
    photos: int
    elsewhere: tuple[str, ...]


@dataclass(frozen=True)
class Refused:
    """Why a mat in the photos gives no size."""

    reason: str


def sightings_in_poses(poses: Poses, detections: dict[str, Seen]) -> list[Sighting]:
    """The placed photos that show the mat; names are those of the image files."""
    lenses = [Lens(*opencv_lens(name, params)) for name, _, _, params in poses.lenses]
    return [
        Sighting(file, lenses[poses.lens_of[file]], poses.cam_from_world[file], detections[file])
        for file in sorted(set(poses.cam_from_world) & set(detections))
    ]


def mat_frame(sightings: list[Sighting], *, line_mm: float = LINE_MM) -> MatFrame | Refused | None:
    """Size and up of a reconstruction from the mat that its photos show.

    Every corner is triangulated from all photos that see it; pairs of corners give the scale, the
    median counts. Then the mat as a whole is laid where it explains the corners' pixels best.

    Args:
        line_mm: the ruler line's length as measured on the printed sheet.

    Returns:
        None where too little of a mat is seen to say anything; Refused with the reason where what
        is seen contradicts itself.
    """
    kinds = {sighting.seen.paper for sighting in sightings}
    if len(kinds) != 1:
        return Refused("photos show mats of two paper sizes. Use one mat") if kinds else None
    corners = mat_of(kinds.pop(), line_mm=line_mm).corners()
    found = triangulated(sightings)
    if len(found) < LEAST_CORNERS or len({marker for marker, _ in found}) < 2:
        return None
    there = np.stack([corners[marker][k] for marker, k in found])
    here = np.stack(list(found.values()))
    world = _refined(_laid(there, here), sightings, corners)
    off = np.linalg.norm(here - _moved(world, there), axis=1)
    scale = float(np.cbrt(np.linalg.det(world[:3, :3])))
    near = off < 5 * float(np.median(off)) + 1e-12
    residual = float(np.sqrt((off[near] ** 2).mean())) / scale
    width = float(np.ptp(np.concatenate(list(corners.values())), axis=0).max())
    elsewhere = tuple(s.name for s in sightings if _is_elsewhere(s, world, corners))
    reason = _contradiction(residual / width, len(elsewhere), len(sightings), elsewhere)
    if reason is not None:
        return Refused(reason)
    up = world[:3, 2] / scale
    percent = 100 * residual / width
    used = len(sightings) - len(elsewhere)
    return MatFrame(1 / scale, up, world, 1e3 * residual, percent, int(near.sum()), used, elsewhere)


def triangulated(sightings: Iterable[Sighting]) -> dict[tuple[int, int], F64]:
    """(marker, corner) -> (3,) position, for corners that two or more photos see and agree on.

    Least squares of the distances to the rays; the ray that is furthest off is left out until the
    others agree.
    """
    rays: dict[tuple[int, int], list[tuple[F64, F64, float]]] = {}
    for sighting in sightings:
        flat = unbent(sighting.seen.pixels(), sighting.lens)
        turn, shift = sighting.cam_from_world[:3, :3], sighting.cam_from_world[:3, 3]
        center, ahead = -turn.T @ shift, np.c_[flat, np.ones(len(flat))] @ turn
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        for i, direction in enumerate(ahead):
            key = (int(sighting.seen.ids[i // 4]), i % 4)
            rays.setdefault(key, []).append((center, direction, float(sighting.lens.K[0, 0])))
    points = {key: _meeting_point(seen) for key, seen in sorted(rays.items())}
    return {key: point for key, point in points.items() if point is not None}


def unbent(pixels: F64, lens: Lens) -> F64:
    """(N, 2) pixels of a photo as taken, on the plane z = 1 of its camera."""
    flat = cv2.undistortPoints(pixels[:, None], lens.K, lens.distortion)
    return np.asarray(flat[:, 0], np.float64)


def _meeting_point(rays: list[tuple[F64, F64, float]]) -> F64 | None:
    centers, directions = np.stack([r[0] for r in rays]), np.stack([r[1] for r in rays])
    focal = np.array([r[2] for r in rays])
    while len(centers) >= 2:
        across = np.eye(3) - directions[:, :, None] * directions[:, None]
        spread = np.arccos(np.clip(directions @ directions.T, -1, 1)).max()
        if spread < LEAST_ANGLE:
            return None
        point = np.linalg.solve(across.sum(0), (across @ centers[..., None]).sum(0)[:, 0])
        to = point - centers
        depth = (to * directions).sum(1)
        off = np.linalg.norm((across @ to[..., None])[..., 0], axis=1) / np.maximum(depth, 1e-12)
        limit = FAR_PX / 1000 * np.maximum(1000 / focal, 1)
        if (depth > 0).all() and (off < limit).all():
            return np.asarray(point, np.float64)
        keep = np.arange(len(off)) != int(np.argmax(np.where(depth > 0, off, np.inf)))
        centers, directions, focal = centers[keep], directions[keep], focal[keep]
    return None


def _laid(there: F64, here: F64) -> F64:
    """(4, 4) similarity from the mat to the world: scale by the median over pairs of corners."""
    pairs = np.array(list(combinations(range(len(there)), 2)))
    apart = np.linalg.norm(there[pairs[:, 0]] - there[pairs[:, 1]], axis=1)
    far = apart > 0.3 * apart.max()
    span = np.linalg.norm(here[pairs[:, 0]] - here[pairs[:, 1]], axis=1)
    scale = float(np.median(span[far] / apart[far]))
    kept = np.ones(len(there), bool)
    out = np.eye(4)
    for _ in range(5):  # least squares after Umeyama (1991), far corners left out
        a, b = there[kept].mean(0), here[kept].mean(0)
        u, _, vt = np.linalg.svd((here[kept] - b).T @ (there[kept] - a))
        turn = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
        out = similarity(scale, turn, b - scale * turn @ a)
        off = np.linalg.norm(here - _moved(out, there), axis=1)
        kept = off <= 3 * float(np.median(off)) + 1e-12
    return out


def _refined(world: F64, sightings: list[Sighting], corners: dict[int, F64]) -> F64:
    """The similarity that explains the pixels of all corners best; robust against a few wrong."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    scale = float(np.cbrt(np.linalg.det(world[:3, :3])))
    turn, reach = world[:3, :3] / scale, float(np.ptp(np.concatenate(list(corners.values()))))

    def at(x: F64) -> F64:
        moved = Rotation.from_rotvec(x[:3]).as_matrix() @ turn
        return similarity(scale * np.exp(x[6]), moved, world[:3, 3] + scale * reach * x[3:6])

    def miss(x: F64) -> F64:
        here = at(x)
        return np.concatenate([_missed(s, here, corners).ravel() for s in sightings])

    found = least_squares(miss, np.zeros(7), loss="soft_l1", f_scale=0.5)
    return at(found.x)


def _missed(sighting: Sighting, world: F64, corners: dict[int, F64]) -> F64:
    """(N, 2) where the corners are seen less where they should be, pixels."""
    points = _moved(world, sighting.seen.on_mat(corners))
    return sighting.seen.pixels() - shown(points, sighting.cam_from_world, sighting.lens)


def shown(points: F64, cam_from_world: F64, lens: Lens) -> F64:
    """(N, 2) pixels of points (N, 3) in a photo as taken."""
    turn, _ = cv2.Rodrigues(cam_from_world[:3, :3])
    pixels, _ = cv2.projectPoints(points, turn, cam_from_world[:3, 3], lens.K, lens.distortion)
    return np.asarray(pixels[:, 0], np.float64)


def _is_elsewhere(sighting: Sighting, world: F64, corners: dict[int, F64]) -> bool:
    limit = FAR_PX * max(1.0, float(sighting.lens.K[0, 0]) / 1000)
    off = np.linalg.norm(_missed(sighting, world, corners), axis=1)
    return float((off > limit).mean()) > WRONG_SHARE


def _contradiction(
    residual: float, elsewhere: int, photos: int, names: tuple[str, ...]
) -> str | None:
    """Why the mat is not to be believed, in words; None if it is."""
    if elsewhere > max(1, MOVED_SHARE * photos):
        listed = ", ".join(names[:4]) + (" and others" if elsewhere > 4 else "")
        return (
            f"{elsewhere} of {photos} photos show the mat in another place: {listed}. It was moved "
            "between photos, or the photos' places are wrong. The mat is not used for the size"
        )
    if residual > WORST:
        return (
            f"the mat's corners are off by {100 * residual:.1f} % of its width, at most "
            f"{100 * WORST:g} % is right: it was moved or bent, or the photos' places are wrong. "
            "The mat is not used for the size"
        )
    return None


def _moved(world: F64, points: F64) -> F64:
    return np.asarray(points @ world[:3, :3].T + world[:3, 3], np.float64)
