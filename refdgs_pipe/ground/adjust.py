"""Poses and lenses that fit where the photos show known places of the ground."""

from dataclasses import dataclass

import cv2
import numpy as np

from refdgs_pipe.camera import F64

PLACES, PLACE_PX = 80, 0.5  # places of a photo that count fully, more share this weight; spread
HELD, HELD_PX = 4, 1.0  # the same of its sparse points
SOFT = 1.0  # px: larger misses count less and less (Cauchy)
FOCAL, RADIAL = 0.005, 0.05  # spread of what structure from motion misses of a lens
STEPS = 30


@dataclass(frozen=True)
class Sight:
    """What one photo shows. Pixels are those of the lens as it was found at first.

    Args:
        K: (3, 3).
        points: (n, 3) on the ground, world; pixels: (n, 2) where the photo shows them.
        held: (m, 3) sparse points; at: (m, 2) where the photo showed them at first.
        lens: index of its lens.
    """

    K: F64
    points: F64
    pixels: F64
    held: F64
    at: F64
    lens: int


@dataclass(frozen=True)
class State:
    """What is adjusted.

    Args:
        poses: (N, 4, 4) cam_from_world.
        lenses: (L, 2) by which share the focal length is larger, and how much more radial
            distortion k1 there is, than was found at first.
    """

    poses: F64
    lenses: F64


def adjusted(sights: list[Sight], state: State, *, free_lenses: bool) -> tuple[State, float]:
    """Levenberg-Marquardt over all poses and the lenses that they share; also the cost reached.

    Each pose touches only its own photo, so the lenses are solved for first (Schur complement).

    Args:
        sights: one for each pose.
        free_lenses: whether the lenses are adjusted too.
    """
    cost = _cost(sights, state)
    damping = 1e-4
    for _ in range(STEPS):
        tried = _step(sights, state, damping, free_lenses)
        new = _cost(sights, tried)
        if new < cost:
            small = cost - new < 1e-6 * cost
            state, cost, damping = tried, new, damping / 5
            if small:
                break
        else:
            damping *= 10
            if damping > 1e6:
                break
    return state, cost


def seen(sight: Sight, pose: F64, lens: F64, points: F64) -> F64:
    """(N, 2) where a photo shows points, in pixels of the lens as it was at first."""
    return _project(sight.K, pose, lens, points)[0]


def misses(sight: Sight, pose: F64, lens: F64) -> F64:
    """(n,) pixels between where a photo shows its places and where it should."""
    return np.asarray(np.linalg.norm(seen(sight, pose, lens, sight.points) - sight.pixels, axis=1))


def bending(x: F64, lens: F64) -> F64:
    """(..., 1) by which a lens with more k1 stretches x (..., 2), at depth 1."""
    return np.asarray(1 + lens[1] * (x * x).sum(-1, keepdims=True))


def _project(K: F64, pose: F64, lens: F64, points: F64) -> tuple[F64, F64, F64]:
    """Pixels (N, 2), and their derivatives by the pose (N, 2, 6) and by the lens (N, 2, 2)."""
    p = points @ pose[:3, :3].T + pose[:3, 3]
    z = np.where(np.abs(p[:, 2]) < 1e-9, 1e-9, p[:, 2])
    x = p[:, :2] / z[:, None]
    focal = np.array([K[0, 0], K[1, 1]])
    r2 = (x * x).sum(1)
    longer, bent = 1 + lens[0], bending(x, lens)
    pixels = K[:2, 2] + focal * longer * bent * x
    by_x = 2 * lens[1] * x[:, :, None] * x[:, None, :] + bent[:, :, None] * np.eye(2)
    by_x *= (focal * longer)[:, None]
    x_by_p = np.zeros((len(p), 2, 3))
    x_by_p[:, 0, 0] = x_by_p[:, 1, 1] = 1 / z
    x_by_p[:, :, 2] = -x / z[:, None]
    turn = np.zeros((len(p), 3, 3))  # of p by a small turn: minus the cross product's matrix
    turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = p[:, 2], -p[:, 1], p[:, 0]
    turn -= turn.transpose(0, 2, 1)
    p_by_pose = np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], 2)
    by_lens = np.stack([focal * bent * x, focal * longer * r2[:, None] * x], 2)
    return pixels, by_x @ x_by_p @ p_by_pose, by_lens


def _weights(sight: Sight) -> tuple[float, float]:
    """Of each place, and of each sparse point."""
    place = min(1.0, PLACES / max(len(sight.points), 1)) / PLACE_PX**2
    return place, min(1.0, HELD / max(len(sight.held), 1)) / HELD_PX**2


def _cost(sights: list[Sight], state: State) -> float:
    """Squared misses of all photos, weighed, and those of the lenses by their spread."""
    total = float(((state.lenses / (FOCAL, RADIAL)) ** 2).sum())
    for sight, pose in zip(sights, state.poses, strict=True):
        lens = state.lenses[sight.lens]
        on, held = _weights(sight)
        off = misses(sight, pose, lens) / SOFT
        apart = seen(sight, pose, lens, sight.held) - sight.at
        total += float(on * SOFT**2 * np.log1p(off * off).sum() + held * (apart**2).sum())
    return total


def _step(sights: list[Sight], state: State, damping: float, free_lenses: bool) -> State:
    count = state.lenses.size
    S, s = np.diag(np.tile([FOCAL**-2, RADIAL**-2], count // 2)), np.zeros(count)
    s -= np.diag(S) * state.lenses.ravel()
    parts = []
    for sight, pose in zip(sights, state.poses, strict=True):
        lens, columns = state.lenses[sight.lens], slice(2 * sight.lens, 2 * sight.lens + 2)
        H, g = np.zeros((8, 8)), np.zeros(8)
        on, held = _weights(sight)
        pairs = ((sight.points, sight.pixels, on), (sight.held, sight.at, held))
        for i, (points, pixels, weight) in enumerate(pairs):
            at, by_pose, by_lens = _project(sight.K, pose, lens, points)
            J, miss = np.concatenate([by_pose, by_lens], 2), pixels - at
            w = np.full(len(points), weight)
            if i == 0:
                w /= 1 + (miss**2).sum(1) / SOFT**2
            H += np.einsum("nki,n,nkj->ij", J, w, J)
            g += np.einsum("nki,n,nk->i", J, w, miss)
        A = H[:6, :6] + damping * np.diag(np.diag(H)[:6]) + 1e-12 * np.eye(6)
        back = np.linalg.solve(A, np.c_[H[:6, 6:], g[:6]])
        S[columns, columns] += H[6:, 6:] - H[6:, :6] @ back[:, :2]
        s[columns] += g[6:] - H[6:, :6] @ back[:, 2]
        parts.append((back, columns))
    S += damping * np.diag(np.diag(S))
    change = np.linalg.solve(S, s) if free_lenses else np.zeros(count)
    poses = [
        _moved(pose, np.asarray(back[:, 2] - back[:, :2] @ change[columns], np.float64))
        for pose, (back, columns) in zip(state.poses, parts, strict=True)
    ]
    return State(np.stack(poses), state.lenses + change.reshape(-1, 2))


def _moved(pose: F64, step: F64) -> F64:
    """A pose after a small turn and shift of the camera's own axes."""
    out = np.eye(4)
    R = np.asarray(cv2.Rodrigues(step[:3])[0])
    out[:3, :3], out[:3, 3] = R @ pose[:3, :3], R @ pose[:3, 3] + step[3:]
    return out
