"""Colours of the object and of what is round it, as evidence."""

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from refdgs_pipe.ground.shots import F32, Bools, Shot, grown

BINS = 20  # along each axis of Lab
RARE = 2e-5  # probability of a colour that was never seen
LIMIT = 2.5
COLOUR = 0.5  # of the evidence: colours
OWN = 0.7  # how much a photo's own colours count beside those of all


def colour_evidence(
    shots: list[Shot], masks: list[F32], outlines: list[Bools], band: list[int]
) -> list[F32]:
    """(H, W) log odds of background for each photo, by what lies in and around its outline.

    Args:
        masks: (H, W) in [0, 1]; outlines: (H, W) silhouettes of the solid.
        band: pixels; surroundings reach six times as far.
    """
    labs = [_lab(shot.rgb) for shot in shots]
    inner = [
        _histogram(lab, outline & (mask > 0.5))
        for lab, mask, outline in zip(labs, masks, outlines, strict=True)
    ]
    found = [h for h in inner if h is not None]
    if not found:
        return [np.zeros(mask.shape, np.float32) for mask in masks]
    common = np.mean(found, 0)
    out = []
    for lab, mask, outline, reach in zip(labs, masks, outlines, band, strict=True):
        core = _histogram(lab, grown(outline, -2) & (mask > 0.5))
        around = grown(outline, 6 * reach) & ~grown(outline, 2) | outline & (mask <= 0.5)
        behind = _histogram(lab, around)
        if behind is None:
            out.append(np.zeros(mask.shape, np.float32))
            continue
        own = common if core is None else OWN * core + (1 - OWN) * common
        odds = np.log((_looked_up(behind, lab) + RARE) / (_looked_up(own, lab) + RARE))
        out.append(odds.clip(-LIMIT, LIMIT).astype(np.float32))
    return out


def with_colour(value: F32, colour: F32, near: Bools, covers: Bools) -> F32:
    """(H, W) the evidence of the surroundings, and that of colours where it is weak.

    Args:
        value: (H, W) log odds of the plane or the room; colour: (H, W) those by colours alone.
        near: (H, W) near the outline; far from it colours tell of the surroundings only.
        covers: (H, W) where the object may mirror what is round it: colours tell of the object
            only.
    """
    doubt = np.clip(1 - np.abs(value) / 2, 0, 1)
    told = np.where(covers, np.minimum(colour, 0), colour)
    return np.asarray(
        value + COLOUR * doubt * np.where(near, told, np.maximum(told, 0)), np.float32
    )


def _lab(rgb: F32) -> F32:
    """(H, W, 3) CIE Lab in [0, 1]."""
    lab = cv2.cvtColor(rgb, cv2.COLOR_RGB2LAB)
    scaled = (lab + np.array([0, 100, 100])) / np.array([100, 200, 200])
    return np.asarray(scaled.clip(0, 1), np.float32)


def _bins(lab: F32) -> tuple[np.ndarray, ...]:
    index = np.clip(lab * BINS, 0, BINS - 1).astype(np.int64)
    return tuple(index[..., k] for k in range(3))


def _histogram(lab: F32, where: Bools) -> F32 | None:
    if not where.any():
        return None
    counts = np.zeros((BINS,) * 3)
    np.add.at(counts, _bins(lab[where]), 1.0)
    spread = gaussian_filter(counts, 0.8)
    return np.asarray(spread / spread.sum(), np.float32)


def _looked_up(histogram: F32, lab: F32) -> F32:
    return np.asarray(histogram[_bins(lab)], np.float32)
