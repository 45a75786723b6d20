"""Directions of numpy vectors."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", np.float32, np.float64)


def unit(vectors: NDArray[T]) -> NDArray[T]:
    """(..., n) the vectors at length 1, in their own type; zero stays zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-12), vectors.dtype)


def root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n, 128) unit descriptors from SIFT's (Arandjelovic and Zisserman 2012)."""
    total = np.maximum(descriptors.sum(1, keepdims=True), 1e-9)
    return np.asarray(np.sqrt(descriptors / total), np.float32)
