"""Corners of markers to a twentieth of a pixel, from the edges that meet there.

OpenCV's corner refinement wants saddles. A marker's corner is none: blur moves it outwards by half
a pixel. The edges of a marker stay where they are, so lines are laid through them and crossed.
"""

import cv2
import numpy as np

from refdgs_pipe.camera import F64
from refdgs_pipe.color import F32

SAMPLES = 24  # along a side
ENDS = 0.12  # share of a side at each end that its neighbours' blur reaches
STEPS = 25  # across an edge
ROUNDS = 3
CELL = 1 / 8  # the black border, as a part of a marker's side
REACH = (1.2, 4.0)  # px to each side of an edge, at least and at most
FAR = 1.0  # of the reach: how far a corner may lie from its guess


def sharpened(linear: F32, quad: F64) -> F64 | None:
    """The four corners (4, 2) of a black square on white, from good guesses.

    Args:
        linear: (H, W) the photo in linear light, where blur moves no edge.
        quad: (4, 2) pixels, centre of the first pixel at 0.5, clockwise as seen.

    Returns:
        The corners; None where the edges are not clear.
    """
    guess, reach = quad, 0.0
    for _ in range(ROUNDS):
        side = float(np.linalg.norm(guess - np.roll(guess, -1, axis=0), axis=1).min())
        reach = float(np.clip(0.9 * CELL * side, *REACH))
        lines = _edge_lines(linear, guess, reach)
        if lines is None:
            return None
        corners = np.cross(np.roll(lines, 1, axis=0), lines)
        if (np.abs(corners[:, 2]) < 1e-9).any():
            return None
        guess = corners[:, :2] / corners[:, 2:]
    moved = np.linalg.norm(guess - quad, axis=1)
    return guess if moved.max() < FAR * max(reach, 2.0) else None


def _edge_lines(linear: F32, quad: F64, reach: float) -> F64 | None:
    """(4, 3) homogeneous lines through the sides 0-1, 1-2, 2-3, 3-0; None if one is not clear."""
    along = np.linspace(ENDS, 1 - ENDS, SAMPLES)
    start, end = quad, np.roll(quad, -1, axis=0)
    direction = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    outward = np.stack([direction[:, 1], -direction[:, 0]], 1)
    foot = start[:, None] + along[None, :, None] * (end - start)[:, None]
    across = np.linspace(-reach, reach, STEPS)
    places = foot[:, :, None] + across[None, None, :, None] * outward[:, None, None]
    grid = (places.reshape(4, -1, 2) - 0.5).astype(np.float32)
    levels = cv2.remap(linear, grid, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    levels = np.asarray(levels, np.float64).reshape(4, SAMPLES, STEPS)
    rise = np.maximum(np.diff(levels, axis=2), 0)
    middle = (across[1:] + across[:-1]) / 2
    peak = middle[np.argmax(rise, axis=2)]
    near = rise * np.exp(-0.5 * ((middle - peak[..., None]) / (0.5 * reach)) ** 2)
    total = near.sum(axis=2)
    offset = (near * middle).sum(axis=2) / np.maximum(total, 1e-9)
    clear = total > 0.3 * np.median(total)
    lines = []
    for side in range(4):
        if clear[side].sum() < SAMPLES // 2:
            return None
        points = foot[side] + offset[side, :, None] * outward[side]
        lines.append(_line(points[clear[side]]))
    return np.stack(lines)


def _line(points: F64) -> F64:
    """(3,) homogeneous line through points (N, 2), those far off left out."""
    kept = points
    for _ in range(2):
        center = kept.mean(axis=0)
        normal = np.linalg.svd(kept - center, full_matrices=False)[2][1]
        off = np.abs((points - center) @ normal)
        kept = points[off <= max(3 * float(np.median(off)), 0.05)]
    return np.append(normal, -normal @ center)
