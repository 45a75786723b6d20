"""What features beside the ground (object, room) say about how two photos lie on each other.

Each photo's view of the ground gives its camera over its own cells. A quarter turn and a shift of
whole cells then fix the relative pose of a pair, and features that match agree with it or not.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import F64, Lens
from refdgs_pipe.sfm.pattern.cells import turn
from refdgs_pipe.sfm.pattern.lattice import U8, mapped
from refdgs_pipe.sfm.pattern.topview import SIDE, TopView
from refdgs_pipe.vectors import root_sift

MOST_FEATURES = 6000
RATIO = 0.8  # of the distance of the best match to that of the second best
LEAST_MATCHES = 6
OFF_PX = 1.5  # from the epipolar plane, in photos of 640 px
FLIP = np.diag([1.0, -1.0, 1.0])  # cells count downwards as seen, the plane's y upwards


@dataclass(frozen=True)
class Beside:
    """A photo's features that do not lie on the ground.

    Args:
        rays: (n, 3) unit, in the camera's frame; looks: (n, 128) RootSIFT.
        cam_from_cells: (4, 4) of the photo over its own cells, x and -y of the cells, z up.
        off: sine of the angle that a match may be off.
    """

    rays: F64
    looks: NDArray[np.float32]
    cam_from_cells: F64
    off: float


def features_beside(
    grey: U8, pixels_from_cells: F64, view: TopView, lens: Lens, cam_from_cells: F64
) -> Beside:
    """SIFT features of a photo (H, W), without those where `view` shows the ground.

    Args:
        pixels_from_cells: (3, 3) homography; cam_from_cells: (4, 4), as in `Beside`.
    """
    sift = cv2.SIFT.create(MOST_FEATURES, 3, 0.015, 12, 1.6)
    keys, looks = sift.detectAndCompute(grey, None)
    pixels = np.array([key.pt for key in keys], float).reshape(-1, 2) + 0.5
    cells = mapped(np.asarray(np.linalg.inv(pixels_from_cells), np.float64), pixels)
    at = np.round((cells - view.origin) * view.cell + (SIDE - 1) / 2)
    inside = np.asarray((np.abs(at - SIDE / 2) < SIDE / 2 - 1).all(axis=1))
    at = np.where(inside[:, None], at, 0).astype(int)
    ground = np.asarray(cv2.dilate(view.known, np.ones((3, 3), np.uint8)))
    rest = ~(inside & (ground[at[:, 1], at[:, 0]] > 0))
    if not rest.any():
        return Beside(np.zeros((0, 3)), np.zeros((0, 128), np.float32), cam_from_cells, 0.0)
    flat = cv2.undistortPoints(pixels[rest][:, None], lens.K, lens.distortion)[:, 0]
    rays = np.concatenate([flat, np.ones((len(flat), 1))], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    off = OFF_PX * max(grey.shape) / 640 / float(lens.K[0, 0])
    return Beside(rays, root_sift(looks[rest]), cam_from_cells, off)


def matches(one: Beside, other: Beside) -> tuple[F64, F64] | None:
    """Rays (n, 3) and (n, 3) of features that are each other's best match; None if too few."""
    if min(len(one.looks), len(other.looks)) < LEAST_MATCHES:
        return None
    like = one.looks @ other.looks.T
    best, back = like.argmax(1), like.argmax(0)
    rows = np.flatnonzero(back[best] == np.arange(len(best)))
    top = like[rows, best[rows]]
    like[rows, best[rows]] = -1.0
    second = like[rows].max(1)
    apart = np.sqrt(np.maximum(2 - 2 * top, 0)), np.sqrt(np.maximum(2 - 2 * second, 0))
    good = apart[0] < RATIO * apart[1]
    if good.sum() < LEAST_MATCHES:
        return None
    return one.rays[rows[good]], other.rays[best[rows[good]]]


def agreeing(
    one: Beside, other: Beside, matched: tuple[F64, F64], quarters: int, shifts: F64
) -> NDArray[np.int64]:
    """(m,) how many matches fit with the other photo's cells turned and moved by shifts (m, 2).

    A match fits if its rays meet before both cameras, nearly in one plane with the line between
    the cameras (Hartley and Zisserman 2004, 9.2).
    """
    spun = np.eye(3)
    spun[:2, :2] = turn(quarters)
    spun = FLIP @ spun @ FLIP
    R, t = one.cam_from_cells[:3, :3], one.cam_from_cells[:3, 3]
    R_other, t_other = other.cam_from_cells[:3, :3], other.cam_from_cells[:3, 3]
    moved = np.stack([shifts[:, 0], -shifts[:, 1], np.zeros(len(shifts))], 1)
    base = (moved - spun @ R_other.T @ t_other) @ R.T + t  # the other camera, as the first sees it
    mine, theirs = matched[0], matched[1] @ (R @ spun @ R_other.T).T
    along, across = base @ mine.T, base @ theirs.T
    length = (base**2).sum(1, keepdims=True)
    least = np.minimum(length - along**2, length - across**2)
    off = np.abs(base @ np.cross(theirs, mine).T) / np.sqrt(np.maximum(least, 1e-9))
    cosine = (mine * theirs).sum(1)
    before = (along > across * cosine) & (along * cosine > across)
    return np.asarray((before & (off < one.off)).sum(1))
