"""How far pictures, normals, depths and surfaces are from the truth.

Pure functions on arrays. docs/evaluation.md says which protocol uses which of them.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.vectors import unit

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]


def psnr(image: F32, target: F32) -> float:
    """Peak signal-to-noise ratio in dB over all pixels and channels of images in [0, 1].

    Equal images give 120 dB, the largest value.
    """
    error = float(np.mean((image.astype(np.float64) - target) ** 2))
    return -10 * math.log10(max(error, 1e-12))


def psnr_per_channel(image: F32, target: F32) -> float:
    """The mean in dB of the PSNRs of each channel of (..., C) images in [0, 1]; at least `psnr`.

    This is what the code of 3D Gaussian splatting and its followers reports.
    """
    channels = range(image.shape[-1])
    return float(np.mean([psnr(image[..., c], target[..., c]) for c in channels]))


def angle_deg(a: F32 | F64, b: F32 | F64) -> F64:
    """(...) angle in degrees between vectors (..., 3) of any length.

    Exactly 0 for equal vectors, which arccos of a rounded cosine is not (Kahan). A vector of
    length 0 is at 90 degrees to any other.
    """
    a, b = unit(a.astype(np.float64)), unit(b.astype(np.float64))
    apart, along = np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)
    return np.asarray(np.degrees(2 * np.arctan2(apart, along)))


def normal_error_deg(normal: F32, truth: F32, mask: Mask) -> float:
    """Mean angle in degrees between (H, W, 3) normals, over the pixels of the (H, W) mask.

    The foreground protocol. A pixel without a normal (0) counts as 90 degrees.
    """
    return float(angle_deg(normal[mask], truth[mask]).mean())


def normal_error_over_white_deg(normal: F32, alpha: F32, truth: F32) -> float:
    """Mean angle in degrees over all pixels, the all-pixel protocol of Shiny Blender's results.

    Unit normals are laid over the vector (1, 1, 1) by alpha, and both sides are normalised again:
    n A + (1 - A) (1, 1, 1).

    Args:
        normal: (H, W, 3) unit, or 0 where there is none; alpha: (H, W) coverage.
        truth: (H, W, 3) the true normals over (1, 1, 1), of any length.
    """
    a = alpha[..., None].astype(np.float64)
    return float(angle_deg(normal * a + (1 - a), truth).mean())


def depth_error(depth: F32, truth: F32, mask: Mask) -> float:
    """Mean absolute difference of (H, W) depths over the pixels of the mask, in their unit."""
    return float(np.abs(depth[mask].astype(np.float64) - truth[mask]).mean())


def mask_iou(mask: Mask, truth: Mask) -> float:
    """Intersection over union of two masks; 1 if both are empty."""
    either = int((mask | truth).sum())
    return float((mask & truth).sum() / either) if either else 1.0


def nearest(points: F64, targets: F64) -> F64:
    """(N,) distance of points (N, 3) to the nearest of targets (M, 3), M > 0."""
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(targets).query(points)
    return np.asarray(distances, np.float64)


def scale_invariant_rmse(values: F32, truth: F32) -> float:
    """Root mean square difference of (N, C) values to the truth, scaled by what fits it best.

    One factor for all channels; of all values 0 it is 1. The unit is the truth's.
    """
    v, t = values.astype(np.float64), truth.astype(np.float64)
    scale = float((v * t).sum() / max(float((v * v).sum()), 1e-30))
    return float(np.sqrt(np.mean((scale * v - t) ** 2)))


def rank_correlation(values: F64, truth: F64) -> float | None:
    """Spearman's rank correlation of (N,) values, equal ones sharing their mean rank.

    None where all values, or all truths, are equal.
    """
    from scipy.stats import rankdata

    a, b = (rankdata(x) - (len(x) + 1) / 2 for x in (values, truth))
    size = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / size) if size else None


@dataclass(frozen=True)
class SurfaceDistances:
    """How far two surfaces are from each other, sample by sample, in one unit of length.

    Args:
        to_truth: (N,) from samples of the result to the truth.
        to_result: (M,) from samples of the truth to the result.
    """

    to_truth: F64
    to_result: F64

    @property
    def accuracy(self) -> float:
        """Mean distance from the result to the truth."""
        return float(self.to_truth.mean())

    @property
    def completeness(self) -> float:
        """Mean distance from the truth to the result."""
        return float(self.to_result.mean())

    @property
    def chamfer(self) -> float:
        """The mean of accuracy and completeness; nothing is capped or squared."""
        return (self.accuracy + self.completeness) / 2

    @property
    def medians(self) -> tuple[float, float]:
        """The median distances from the result to the truth, and back."""
        return float(np.median(self.to_truth)), float(np.median(self.to_result))

    def f_score(self, threshold: float) -> float:
        """Harmonic mean of the shares of either side's samples that are closer than `threshold`.

        As in Tanks and Temples (Knapitsch et al. 2017). 0 if none is.
        """
        precision = float((self.to_truth < threshold).mean())
        recall = float((self.to_result < threshold).mean())
        both = precision + recall
        return 2 * precision * recall / both if both else 0.0


def worst_part(points: F64, distances: F64, *, edge: float, least: int) -> float:
    """Mean distance in the worst part of a surface, so that a dent cannot hide in a mean.

    Parts are the cubes of a grid whose corner is the points' lowest corner.

    Args:
        points: (N, 3) samples spread evenly over the surface; distances: (N,) theirs.
        edge: of the cubes, in the points' unit.
        least: samples of a part that counts; if none has as many, all are one part.
    """
    cells = np.floor((points - points.min(0)) / edge).astype(np.int64)
    _, place = np.unique(cells, axis=0, return_inverse=True)
    place = place.reshape(-1)
    count = np.bincount(place)
    means = np.bincount(place, distances) / count
    large = count >= least
    return float(means[large].max()) if large.any() else float(distances.mean())
