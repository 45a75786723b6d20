"""Directions of numpy vectors."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", np.float32, np.float64)


def unit(vectors: NDArray[T]) -> NDArray[T]:
    """(..., n) the vectors at length 1, in their own type; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12), vectors.dtype)
