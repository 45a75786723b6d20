"""Evidence that is no more than what a capture's own pixels bear out."""

import numpy as np
from scipy.ndimage import gaussian_filter1d

from refdgs_pipe.ground.shots import Bools, Shot
from refdgs_pipe.masking.table import LIMIT, Evidence, contrast

CONTRASTS = (0.02, 0.06, 0.15)  # of log brightness, between which values are judged apart
SIGMA = 1.8  # pixels over which contrast is measured
STEP, BROAD = 0.2, 1.0  # of values that are counted together; steps over which counts are spread
RARE = 0.01  # share of the pixels that any value is given
LEAST_PIXELS = 500


def calibrated(
    evidence: list[Evidence],
    shots: list[Shot],
    inner: list[Bools],
    outer: list[Bools],
) -> list[Evidence]:
    """The same evidence, where the capture bears it out; less or none where it does not.

    What is plain is like something else somewhere. How much that tells depends on the object, so
    values are counted where a photo shows the object, and where it does not. No evidence is larger
    than the log odds that these counts give it, or of another sign. Pixels are told apart by their
    contrast.

    Args:
        inner, outer: (H, W) where each photo shows the object, and where it does not, as far as
            is known.
    """
    levels = [np.digitize(contrast(shot.logs.mean(-1), SIGMA), CONTRASTS) for shot in shots]
    steps = [np.round((e.value + LIMIT) / STEP).astype(np.int64) for e in evidence]
    counts = np.zeros((2, len(CONTRASTS) + 1, round(2 * LIMIT / STEP) + 1))
    for one, level, step, *parts in zip(evidence, levels, steps, inner, outer, strict=True):
        for count, part in zip(counts, parts, strict=True):
            there = part & one.known
            np.add.at(count, (level[there], step[there]), 1.0)
    total = counts.sum(-1, keepdims=True)
    shares = gaussian_filter1d(counts, BROAD, axis=-1, mode="nearest") / np.maximum(total, 1)
    odds = np.log((shares[1] + RARE) / (shares[0] + RARE)).clip(-LIMIT, LIMIT)
    enough = total.min(0)[:, 0] >= LEAST_PIXELS
    out = []
    for one, level, step in zip(evidence, levels, steps, strict=True):
        told = np.where(enough[level], odds[level, step], one.value)
        least = np.minimum(np.abs(told), np.abs(one.value))
        value = np.where(told * one.value > 0, np.sign(told) * least, 0)
        out.append(Evidence(np.where(one.known, value, 0).astype(np.float32), one.known))
    return out
