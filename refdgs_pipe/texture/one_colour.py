"""Parts of a mesh that have one colour, and so are taken for one material.

A part may be lit unevenly, so brightness may differ more than hue. Neighbours are joined, the most
alike first, as long as the mean colours of both parts are alike (region merging in the order of
Nock and Nielsen 2004, "Statistical region merging"). So a part that changes its colour little by
little is not joined as a whole.
"""

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_APART = 0.12  # log colour, between the means of two parts of one material
_BRIGHTNESS = 0.3  # weight of brightness, beside that of hue
_DIMMEST = 0.02  # linear, added to colours before logarithms


def mean_over_parts(values: F32, weights: F64, part: Ints) -> F64:
    """(P,) the weighted mean of values (V,) over each part.

    Args:
        weights: (V,) above 0; part: (V,) of each vertex, from 0 on.
    """
    return np.asarray(np.bincount(part, values * weights) / np.bincount(part, weights))


def parts_of_one_colour(colors: F32, links: Ints) -> Ints:
    """(V,) the number of the part that each vertex lies in, from 0 on.

    Args:
        colors: (V, 3) linear; links: (E, 2) neighbouring vertices.
    """
    logs = np.log(np.maximum(colors, 0).astype(np.float64) + _DIMMEST)
    bright = logs.mean(1, keepdims=True)
    logs += (_BRIGHTNESS - 1) * bright
    apart = np.abs(logs[links[:, 0]] - logs[links[:, 1]]).max(1)
    order = np.argsort(apart, kind="stable")
    joined = _Joined(logs)
    for a, b in links[order[apart[order] < _APART]].tolist():
        joined.join(a, b)
    found = np.array([joined.root(i) for i in range(len(colors))], np.int64)
    return np.asarray(np.unique(found, return_inverse=True)[1].reshape(-1), np.int64)


class _Joined:
    """Vertices with values (V, 3), joined to parts (union-find)."""

    def __init__(self, values: F64) -> None:
        self._parent = list(range(len(values)))
        self._count = [1.0] * len(values)
        self._sum = values.tolist()

    def root(self, i: int) -> int:
        """The vertex that stands for the part of another one."""
        parent = self._parent
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    def join(self, a: int, b: int) -> None:
        """Join the parts of two vertices, if their means are alike."""
        a, b = self.root(a), self.root(b)
        if a == b:
            return
        m, n, one, other = self._count[a], self._count[b], self._sum[a], self._sum[b]
        if max(abs(x / m - y / n) for x, y in zip(one, other, strict=True)) >= _APART:
            return
        if m < n:
            a, b = b, a
        self._parent[b] = a
        self._count[a] = m + n
        self._sum[a] = [x + y for x, y in zip(one, other, strict=True)]
