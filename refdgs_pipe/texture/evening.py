"""Values at vertices that are evened between neighbours of one material."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_OTHER, _ACROSS = 0.25, 1e-4  # log colour of another material; the weight across its border
_DIMMEST = 0.02  # linear, added to colours before logarithms
_EXACT = 1e-4  # residual of the solution, beside the first one
_MOST_STEPS = 2000


def evened(
    values: F32, evidence: F32, colors: F32, links: Ints, reach: float, exact: float = _EXACT
) -> F32:
    """(V,) near the values, and even between neighbours that look alike.

    A part of one colour has one material. Least squares: evidence (k - value)^2 at each vertex, and
    (k - k')^2 for each edge, times a weight that is small where the colour changes.

    Args:
        evidence: (V,) how much each value counts, above 0.
        colors: (V, 3) linear, what is seen of each vertex in the mean; links: (E, 2).
        reach: in edges, for each square root of the number of vertices.
        exact: residual at which the solution ends, beside the first. The longer the reach, the
            smaller it has to be.
    """
    a, b = links.T
    count = len(values)
    logs = np.log(np.maximum(colors, 0) + _DIMMEST)
    apart = np.abs(logs[a] - logs[b]).max(1)
    weight = (reach**2 * count) * (np.exp(-((apart / _OTHER) ** 2)) + _ACROSS)
    own = evidence.astype(np.float64)
    diagonal = own + np.bincount(a, weight, count) + np.bincount(b, weight, count)

    def applied(k: F64) -> F64:
        return np.asarray(
            diagonal * k
            - np.bincount(a, weight * k[b], count)
            - np.bincount(b, weight * k[a], count)
        )

    start = values.astype(np.float64)
    return _solved(applied, diagonal, own * values, start, exact).astype(np.float32)


def _solved(
    applied: Callable[[F64], F64], diagonal: F64, wanted: F64, start: F64, exact: float
) -> F64:
    """(V,) the solution of a positive definite system, by conjugate gradients.

    Written here, because the sums of scipy's solver depend on the number of threads.

    Args:
        applied: the matrix times a vector; diagonal: (V,) of the matrix; wanted: (V,) right side.
    """
    found = start.copy()
    rest = wanted - applied(found)
    step = rest / diagonal
    along, before = step.copy(), float((rest * step).sum())
    enough = exact**2 * max(before, 1e-30)
    for _ in range(_MOST_STEPS):
        if before <= enough:
            break
        turned = applied(along)
        far = before / float((along * turned).sum())
        found += far * along
        rest -= far * turned
        step = rest / diagonal
        now = float((rest * step).sum())
        along, before = step + now / before * along, now
    return found
