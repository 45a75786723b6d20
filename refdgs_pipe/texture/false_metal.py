"""What was taken for metal, but is rather of one colour in all views.

Where the mesh is not the surface, colours vary from view to view as a metal's do. A print on a
clock's face, seen through a wrong mesh, looks like a metal that mirrors something. Neighbours of
like colour are judged together, so that a metal that is fitted well in most places stays whole, and
a print beside it does not decide about it.
"""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.texture.evening import evened

F32 = NDArray[np.float32]
Bools = NDArray[np.bool_]

_LENIENT = 1.75  # a metal on a mesh that is a little wrong mirrors other light than the views show
_REACH = 0.15  # range, in edges, for each square root of the number of vertices
_LEAST_EVIDENCE = 1e-3  # of what no view shows
_EXACT = 1e-6  # of the solution


def false_metal(
    metal: Bools, missed: F32, varied: F32, colors: F32, links: NDArray[np.int64]
) -> Bools:
    """(V,) which metal is none: where one colour a place explains the views much better.

    Args:
        metal: (V,) what was taken for metal.
        missed: (V,) squared differences between what the views show and what the fit does.
        varied: (V,) squared differences between what the views show and its mean at each place.
        colors: (V, 3) linear, what is seen of each vertex in the mean; links: (E, 2) neighbours.
    """
    if not metal.any():
        return metal
    bound = _LENIENT * varied
    both = missed + bound
    share = both / max(float(both[metal].mean()), 1e-9)
    evidence = np.maximum(np.where(metal, share, 0), _LEAST_EVIDENCE).astype(np.float32)
    value = np.where(metal, (missed - bound) / np.maximum(both, 1e-9), 0)
    within = links[metal[links].all(1)]
    found = evened(value.astype(np.float32), evidence, colors, within, _REACH, _EXACT)
    return np.asarray(metal & (found > 0))
