"""Cameras of people with habits: near, far, in haste, turned, from above or from low.

Each function gives (eye, point looked at, roll in radians) of each photo, in scene units.
"""

import numpy as np
from places import LOWERED, _eye, rings

Shots = list[tuple[np.ndarray, np.ndarray, float]]


def _level(shots: list[tuple[np.ndarray, np.ndarray]], rng: np.random.Generator) -> Shots:
    return [(eye, at, np.deg2rad(rng.normal(0, 2.5))) for eye, at in shots]


def near_and_far(n: int, rng: np.random.Generator) -> Shots:
    """Two rings from afar; a third of the photos are close-ups that show parts of the object."""
    whole = rings(n - n // 3, rng, radius=3.6, levels=(18, 42))
    out = _level(whole, rng)
    for k in range(n // 3):
        azimuth = 2 * np.pi * (k + rng.uniform(-0.3, 0.3)) / (n // 3)
        eye = _eye(rng.uniform(1.9, 2.4), azimuth, np.deg2rad(rng.uniform(15, 50))) - LOWERED
        out.append((eye, rng.normal(0, 0.3, 3), np.deg2rad(rng.normal(0, 6))))
    return out


def far_away(n: int, rng: np.random.Generator) -> Shots:
    """Three rings at twice the distance: the object is a small part of each photo."""
    return _level(rings(n, rng, radius=6.8), rng)


def in_haste(n: int, rng: np.random.Generator) -> Shots:
    """One and a half rounds in unequal steps, badly aimed."""
    steps = rng.uniform(0.5, 1.5, n)
    azimuths = 3 * np.pi * np.cumsum(steps) / steps.sum()
    out = []
    for k, azimuth in enumerate(azimuths):
        elevation = np.deg2rad(20 + 25 * (k > 0.66 * n) + rng.normal(0, 5))
        eye = _eye(rng.uniform(3.0, 4.2), azimuth, elevation) - LOWERED
        out.append(
            (eye, np.array([0, 0, -0.1]) + rng.normal(0, 0.25, 3), np.deg2rad(rng.normal(0, 5)))
        )
    return out


def turned(n: int, rng: np.random.Generator) -> Shots:
    """Rings; in half of the photos the camera is held upright, and no EXIF says so."""
    return [
        (eye, at, roll + (np.pi / 2 if rng.random() < 0.5 else 0.0))
        for eye, at, roll in _level(rings(n, rng), rng)
    ]


def from_above(n: int, rng: np.random.Generator) -> Shots:
    """The object lies on the floor: all photos from 40 to 75 degrees."""
    return _level(rings(n, rng, levels=(42, 58, 74)), rng)


def from_low(n: int, rng: np.random.Generator) -> Shots:
    """One ring from a low height; no photo shows the object from above."""
    return _level(rings(n, rng, levels=(14, 24)), rng)
