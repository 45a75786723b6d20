"""Which parts of one colour are metal.

What a place sends is a line in the light that it mirrors. Plastic adds little of that light, in no
colour of its own, to a colour that does not vary. Metal sends nothing but that light, in its own
colour: what varies is as coloured as what is seen. One place tells this badly, as its normal and
its light are a little wrong. A whole part tells it well.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

# Slope in the strongest colour: metal from there on (plastic has 0.1, or 0.4 where the light is
# wrong); up to the other, a part may be plastic by its colour.
_METAL, _PLASTIC = 0.5, 0.3
_VARIED = 0.02  # linear: light that deviates less tells nothing
_FEWEST = 100  # samples of a part that tell anything
_COLOURED = 1.0  # log of seen by mirrored, beside that of green: gold has 0.9, red paint 2
_PLAIN = 0.4  # of it: what varies has less of that colour, so none of its own


@dataclass(frozen=True)
class Lines:
    """What each of P parts sends, as a line in what it mirrors: seen = slope * mirrored + rest.

    Args:
        slope: (P, 3); tint: (P, 3) mean of what is seen by that of what is mirrored.
        told: (P,) whether enough samples saw light that varies.
    """

    slope: F64
    tint: F64
    told: Bools

    @classmethod
    def of(cls, part: Ints, corners: Any, seen: F32, mirrored: F32, counted: Bools) -> "Lines":
        """Lines fitted to samples; the rest may differ from vertex to vertex.

        Args:
            part: (V,) of each vertex, from 0 on; corners: sparse (N, V), from vertices to samples.
            seen, mirrored: (N, 3) linear, clipped at white; counted: (N,) samples that count.
        """
        weight = counted[:, None].astype(np.float64)
        number = corners.T @ weight
        a, b, both, square = (
            corners.T @ (weight * v) for v in (mirrored, seen, mirrored * seen, mirrored * mirrored)
        )

        def summed(values: F64) -> F64:
            return np.stack([np.bincount(part, values[:, i]) for i in range(values.shape[1])], 1)

        known = np.maximum(number, 1e-6)
        varied = np.maximum(summed(square - a * a / known), 1e-12)
        slope = np.maximum(summed(both - a * b / known) / varied, 1e-3)
        count = summed(number)
        told = (count[:, 0] >= _FEWEST) & (varied.mean(1) > _VARIED**2 * count[:, 0])
        tint = np.maximum(summed(b), 1e-9) / np.maximum(summed(a), 1e-9)
        return cls(slope, tint, told)

    def metal(self, guess: Bools) -> Bools:
        """(P,) which parts are metal.

        Args:
            guess: (P,) what is taken where the lines do not tell.
        """
        own, varies = (np.log(v / v[:, 1:2]) for v in (self.tint, self.slope))
        most = np.abs(own).argmax(1)[:, None]
        own, varies = (np.take_along_axis(v, most, 1)[:, 0] for v in (own, varies))
        plain = (np.abs(own) > _COLOURED) & (varies * np.sign(own) < _PLAIN * np.abs(own))
        strong = self.slope.max(1)
        metal = (strong > _METAL) | (guess & ~(plain & (strong < _PLASTIC)))
        return np.asarray(np.where(self.told, metal, guess))
