"""Photos that hang together among themselves, but not with the others: the weakest cut.

Photos of a mirrored, repeated or other scene can form a group of their own that fits together well
and is joined to the others in a wrong place by a few points. Photo by photo nothing speaks against
them. Across the cut between the two groups, most verified matches contradict the places.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.placement import Evidence
from refdgs_pipe.camera import F64

CONTRADICTED = 0.7  # of the matches across a cut, above which its sides do not belong together
LEAST_MATCHES = 30  # across a cut, that say anything
LEAST_PHOTOS = 4


@dataclass(frozen=True)
class Cut:
    """Photos that the others contradict.

    Args:
        files: of the smaller side; against: share of the matches across that contradict it.
    """

    files: tuple[str, ...]
    against: float


def contradicted_group(evidence: Evidence, files: list[str]) -> Cut | None:
    """The smaller side of the weakest cut through these photos, if the matches across it
    contradict the places; None where one group holds together.
    """
    if len(files) < LEAST_PHOTOS:
        return None
    row = {name: i for i, name in enumerate(evidence.names)}
    index = np.full(len(evidence.names), -1)
    index[[row[file] for file in files]] = np.arange(len(files))
    a, b = index[evidence.pairs].T
    known = (a >= 0) & (b >= 0)
    a, b = a[known], b[known]
    shared = np.zeros((len(files), len(files)))
    shared[a, b] = shared[b, a] = evidence.shared[known]
    one = weakest_cut(shared)
    inliers, agree = evidence.inliers[known], evidence.agree[known]
    across = (one[a] != one[b]) & ~np.isnan(agree)
    total = float(inliers[across].sum())
    against = float(((1 - agree[across]) * inliers[across]).sum()) / max(total, 1.0)
    if total < LEAST_MATCHES or against <= CONTRADICTED:
        return None
    smaller = one if 2 * one.sum() <= len(files) else ~one
    return Cut(tuple(file for file, there in zip(files, smaller, strict=True) if there), against)


def weakest_cut(weights: F64) -> NDArray[np.bool_]:
    """(n,) the two sides of the cut of least conductance along the Fiedler vector.

    Spectral partitioning of the normalised Laplacian (Shi and Malik 2000). The first row's side is
    False: an eigenvector's sign is not determined.

    Args:
        weights: (n, n) symmetric, not negative, zero on the diagonal.
    """
    weights = weights + 1e-6 * max(float(weights.max()), 1.0) * (1 - np.eye(len(weights)))
    degree = weights.sum(1)
    scale = 1 / np.sqrt(degree)
    laplacian = np.eye(len(weights)) - weights * scale[:, None] * scale
    order = np.argsort(np.linalg.eigh(laplacian)[1][:, 1] * scale, kind="stable")
    within = np.diagonal(weights[order][:, order].cumsum(0).cumsum(1))[:-1]
    volume = degree[order].cumsum()[:-1]
    conductance = (volume - within) / np.minimum(volume, degree.sum() - volume)
    out = np.zeros(len(weights), bool)
    out[order[: int(conductance.argmin()) + 1]] = True
    return np.asarray(out != out[0])
