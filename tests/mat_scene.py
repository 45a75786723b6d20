"""Photos of a mat through cameras that are known exactly, made by warping its drawing."""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from refdgs_pipe.camera import F64
from refdgs_pipe.mat.detection import Seen
from refdgs_pipe.mat.drawing import U8, picture
from refdgs_pipe.mat.layout import Mat, mat_of

PER_MM = 4.0
SIZE = (640, 480)
FOCAL = 620.0


@dataclass(frozen=True)
class Shot:
    """A photo and what is true of it.

    Args:
        grey: (H, W); K: (3, 3), pixel centres at +0.5; k1: OpenCV's radial distortion.
        cam_from_mat: (4, 4), metres.
    """

    grey: U8
    K: F64
    k1: float
    cam_from_mat: F64


@cache
def drawn(paper: str = "a4", texture: bool = True) -> U8:
    """The mat's drawing at `PER_MM` pixels a millimetre."""
    return picture(mat_of(paper), PER_MM, texture=texture)  # type: ignore[arg-type]


def looking_at(eye: tuple[float, float, float], roll: float = 0.0) -> F64:
    """(4, 4) camera (OpenCV) from the mat's frame, looking at the mat's middle; roll in radians."""
    z = -np.array(eye) / np.linalg.norm(eye)
    x = np.cross(z, [0, 0, 1.0])
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0, 0])
    turn = np.stack([x, np.cross(z, x), z])
    c, s = np.cos(roll), np.sin(roll)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]) @ turn
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn, -turn @ np.array(eye)
    return out


def ring(count: int, elevation: float, distance: float = 0.45, start: float = 0.0) -> list[F64]:
    """Camera poses all round; elevation in degrees, distance in metres."""
    height = np.radians(elevation)
    poses = []
    for step in range(count):
        turn = start + 2 * np.pi * step / count
        flat = distance * np.cos(height)
        eye = (flat * np.cos(turn), flat * np.sin(turn), distance * np.sin(height))
        poses.append(looking_at(eye, roll=0.05 * np.sin(3 * turn)))
    return poses


def photo(
    pose: F64, *, k1: float = 0.0, scale: float = 1.0, seed: int = 0, **paper: object
) -> Shot:
    """The mat on a dark table, blurred to a lens's sharpness, with noise.

    Args:
        pose: cam_from_mat, metres; scale: size, as a part of 640 x 480.
    """
    width, height = round(SIZE[0] * scale), round(SIZE[1] * scale)
    K = np.array([[FOCAL * scale, 0, width / 2], [0, FOCAL * scale, height / 2], [0, 0, 1]])
    mat: Mat = mat_of(str(paper.get("paper", "a4")))  # type: ignore[arg-type]
    art = drawn(**paper)  # type: ignore[arg-type]
    fine = 2  # drawn larger, then averaged: no aliasing
    u, v = np.meshgrid(np.arange(width * fine) + 0.5, np.arange(height * fine) + 0.5)
    rays = np.stack([u / fine, v / fine], -1).reshape(-1, 1, 2)
    flat = (rays[:, 0] - K[:2, 2]) / K[0, 0]
    if k1:
        flat = cv2.undistortPoints(rays, K, np.array([k1, 0, 0, 0, 0]))[:, 0]
    inverse = np.linalg.inv(pose[:3, [0, 1, 3]])
    on_mat = np.c_[flat, np.ones(len(flat))] @ inverse.T
    ahead = on_mat[:, 2] > 0
    on_mat = 1e3 * on_mat[:, :2] / np.where(ahead, on_mat[:, 2], 1)[:, None]
    x = (on_mat[:, 0] + mat.width / 2) * PER_MM - 0.5
    y = (mat.height / 2 - on_mat[:, 1]) * PER_MM - 0.5
    x, y = np.where(ahead, x, -9), np.where(ahead, y, -9)
    grid = np.stack([x, y], -1).reshape(height * fine, width * fine, 2).astype(np.float32)
    linear = (art.astype(np.float32) / 255) ** 2.2
    large = cv2.remap(linear, grid, None, cv2.INTER_LINEAR, borderValue=0.03)
    small = cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), 0.6) * 0.8
    noise = np.random.default_rng(seed).normal(0, 0.004, small.shape)
    grey = np.clip(small + noise, 0, 1) ** (1 / 2.2)
    return Shot(np.round(grey * 255).astype(np.uint8), K, k1, pose)


def projected(shot: Shot, points: F64) -> F64:
    """(N, 2) pixels of points (N, 3) on the mat."""
    turn, _ = cv2.Rodrigues(shot.cam_from_mat[:3, :3])
    lens = np.array([shot.k1, 0, 0, 0, 0])
    return np.asarray(cv2.projectPoints(points, turn, shot.cam_from_mat[:3, 3], shot.K, lens)[0])[
        :, 0
    ]


def sighted(shot: Shot, *, hidden: float = 0.4, noise: float = 0.1, seed: int = 0) -> Seen:
    """What a detector would find, without drawing a picture.

    Args:
        hidden: share of the markers that the object hides; noise: of each corner, pixels.
    """
    draw = np.random.default_rng(seed)
    corners = mat_of("a4").corners()
    ids = [i for i in corners if draw.uniform() > hidden]
    pixels = np.stack([projected(shot, corners[i]) for i in ids])
    return Seen("a4", np.array(ids), pixels + draw.normal(0, noise, pixels.shape))


def unseen(pose: F64, k1: float = 0.0) -> Shot:
    """A photo's truth without its picture."""
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    return Shot(np.zeros((0, 0), np.uint8), K, k1, pose)
