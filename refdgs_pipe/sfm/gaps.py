"""What sides of the object no photo shows, in words."""

from collections.abc import Mapping

import numpy as np

from refdgs_pipe.artifacts.sparse_model import SparseModel

GAP_DEG = 60.0  # between neighbours round the object, from which on a gap is named
ROUND_DEG = 180.0  # without a wider gap, photos go round the object
LOW_DEG, HIGH_DEG = 30.0, 35.0  # a lowest photo above, or a highest below, is named


def gaps_of(model: SparseModel, said: Mapping[str, str]) -> tuple[str, ...]:
    """Sentences on wide gaps between neighbouring photos round the object, widest first, and on
    heights that no photo was taken from."""
    around = _azimuths(model)
    order = sorted(around, key=lambda name: around[name])
    if len(order) < 3:
        return ()
    found = []
    for name, after in zip(order, [*order[1:], order[0]], strict=True):
        gap = (around[after] - around[name]) % 360.0
        if gap >= GAP_DEG:
            found.append((gap, name, after))
    gaps = [
        f"between {said[name]} and {said[after]} there is a gap of {gap:.0f} degrees"
        for gap, name, after in sorted(found, reverse=True)
    ]
    goes_round = all(gap < ROUND_DEG for gap, *_ in found)
    return tuple(gaps + (_missing_heights(model) if goes_round else []))


def _missing_heights(model: SparseModel) -> list[str]:
    """Sentences on photos that all look down steeply, or that none does."""
    up = model.up / np.linalg.norm(model.up)
    heights = []
    for camera in model.cameras:
        away = camera.center - model.ball.center
        heights.append(np.degrees(np.arcsin(np.clip(away @ up / np.linalg.norm(away), -1, 1))))
    lowest, highest = min(heights), max(heights)
    if lowest > LOW_DEG:
        return [
            f"all photos look down from {lowest:.0f} degrees or more: the shape of a plain top and "
            "of the walls is uncertain. A ring of photos from 10 to 20 degrees shows it"
        ]
    if highest < HIGH_DEG:
        return [
            f"no photo looks down from more than {highest:.0f} degrees: what faces up is "
            "uncertain. A ring of photos from 45 to 60 degrees shows it"
        ]
    return []


def _azimuths(model: SparseModel) -> dict[str, float]:
    """Name of a camera -> degrees round the up axis, seen from the object."""
    up = model.up / np.linalg.norm(model.up)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    front = np.cross(up, side)
    away = {camera.name: camera.center - model.ball.center for camera in model.cameras}
    return {
        name: float(np.degrees(np.arctan2(line @ front, line @ side)))
        for name, line in away.items()
    }
