"""Sparse matrices of the fit: samples from vertices, and from pictures of the light."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.light import lookups

F32 = NDArray[np.float32]
Ints = NDArray[np.int64]


def corner_matrix(mesh: TriangleMesh, face: Ints, weights: F32) -> Any:
    """Sparse (N, V): values at places in faces from values at vertices."""
    from scipy.sparse import csr_array

    start = np.arange(0, 3 * len(face) + 1, 3)
    columns = mesh.faces[face].reshape(-1)
    shape = (len(face), len(mesh.vertices))
    return csr_array((weights.reshape(-1).astype(np.float32), columns, start), shape=shape)


def look_matrix(directions: F32, height: int) -> Any:
    """Sparse (N, 2 height^2): values in directions from a lat-long picture."""
    from scipy.sparse import csr_array

    index, weights = lookups(directions, height)
    start = np.arange(0, 4 * len(index) + 1, 4)
    shape = (len(index), 2 * height * height)
    return csr_array((weights.reshape(-1), index.reshape(-1), start), shape=shape)
