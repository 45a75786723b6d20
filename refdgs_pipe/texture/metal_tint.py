"""The colour of metals, and how bright the far light is, from what metals mirror.

A place of a metal shows tint * (ground + unit * rest), where the photos tell the light of the
ground, and that of the rest is known but for its unit. Places of one metal mirror the ground and
the rest in different shares. Only the right unit gives all of them one tint.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.texture.evening import evened

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_UNITS = np.exp2(np.linspace(-1.5, 1.5, 13))
_KEPT = 0.05  # how much a unit far from 1 counts against itself, for each squared logarithm
_SILVER = 0.95  # no metal reflects much more than polished silver
_OVER = 20.0  # how much a tint above that counts against a unit, for each squared logarithm
_REACH, _EXACT = 0.3, 1e-5  # of `evened`
_LEAST_EVIDENCE = 1e-6  # of what no view shows, beside the mean
_DIM, _DARKEST = 0.15, 1e-4  # linear: what is darker counts less; the least that has a logarithm
# A ray to the ground counts half if the edge of its lobe gives it this share of its light, because
# the width of the lobe is not known well. On brown wood about half of the blue light comes from
# there.
_TAIL = 0.15
_LEAST, _MOST = 0.02, 0.98


@dataclass(frozen=True)
class Mirrored:
    """N samples of metals.

    Args:
        seen: (N, 3) linear radiance that views show.
        ground, rest: (N, 3) linear radiance that is mirrored, of the ground and of the rest.
        share: (N, 1) of the ground in the mirrored lobe.
        scale, offset: (N, 1) of `reflection_line`.
        corners: sparse (N, V), from vertices to samples.
    """

    seen: F32
    ground: F32
    rest: F32
    share: F32
    scale: F32
    offset: F32
    corners: Any

    def sums(self, unit: float) -> tuple[F64, F64, F64]:
        """(V, 3) weights, and of the logarithm of the tint that each sample tells, and its square.

        Logarithms, because the light may be wrong by a factor as easily as what is seen.
        """
        light = self.ground + np.float32(unit) * self.rest
        shown = np.maximum(self.seen - self.offset * light, np.float32(_DARKEST))
        told = np.log(shown / np.maximum(self.scale * light, np.float32(_DARKEST)))
        tail = self.share * np.float32(unit) * self.rest / np.maximum(light, np.float32(_DARKEST))
        weight = (self.seen / (self.seen + np.float32(_DIM))) ** 2
        weight = weight / (1 + (tail / np.float32(_TAIL)) ** 2)
        back = self.corners.T
        count, first, second = (
            np.asarray(back @ values, np.float64)
            for values in (weight, weight * told, weight * told * told)
        )
        return count, first, second


def even_tint(mirrored: Mirrored, metal: Bools, colors: F32, links: Ints) -> tuple[float, F32]:
    """The unit of the far light, and (V, 3) the tint of metals, even between like neighbours.

    Without metal the unit is 1, and the tint means nothing.

    Args:
        metal: (V,) which vertices are of metal.
        colors: (V, 3) linear, what is seen of each vertex in the mean; links: (E, 2) neighbours.
    """
    if not metal.any():
        return 1.0, np.full(colors.shape, _MOST, np.float32)
    within = links[metal[links].all(1)]
    best = (np.inf, 1.0, np.zeros(colors.shape, np.float32))
    for unit in _UNITS:
        count, first, second = mirrored.sums(float(unit))
        tint = _evened(count, first, metal, colors, within)
        missed = float((second - 2 * tint * first + tint * tint * count)[metal].sum())
        missed /= max(float(count[metal].sum()), 1e-9)
        over = np.maximum(tint[metal].max(1) - np.log(_SILVER), 0)
        cost = np.log(max(missed, 1e-12)) + _KEPT * np.log(unit) ** 2
        cost += _OVER * float((over * over).mean())
        if cost < best[0]:
            best = (cost, float(unit), tint)
    return best[1], np.clip(np.exp(best[2]), _LEAST, _MOST).astype(np.float32)


def _evened(count: F64, first: F64, metal: Bools, colors: F32, within: Ints) -> F32:
    """(V, 3) weighted means, first / count, even between neighbours that look alike."""
    columns = []
    for own, both in zip(count.T, first.T, strict=True):
        evidence = np.where(metal, own, 0) / max(float(own[metal].mean()), 1e-12)
        value = np.asarray(both / np.maximum(own, 1e-12), np.float32)
        counts = np.asarray(evidence + _LEAST_EVIDENCE, np.float32)
        columns.append(evened(value, counts, colors, within, _REACH, _EXACT))
    return np.stack(columns, 1)
