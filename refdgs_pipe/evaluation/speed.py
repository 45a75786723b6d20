"""How fast views are drawn."""

import statistics
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.camera import Camera

F32 = NDArray[np.float32]


class Timed:
    """Draws pictures and remembers how long each took. The first is drawn twice, to warm up."""

    def __init__(self, draw: Callable[[Camera], F32]) -> None:
        self._draw = draw
        self._seconds: list[float] = []
        self.size = (0, 0)  # width and height of the last picture

    def __call__(self, camera: Camera) -> F32:
        """(H, W, 3) the picture; it is on the CPU, so that no work is left when the clock stops."""
        if not self._seconds:
            self._draw(camera)
        begin = time.perf_counter()
        picture = self._draw(camera)
        self._seconds.append(time.perf_counter() - begin)
        self.size = (picture.shape[1], picture.shape[0])
        return picture

    @property
    def told(self) -> str:
        """Width and height of the last picture, in words."""
        return "{} x {}".format(*self.size)

    @property
    def per_second(self) -> float:
        """Views per second: one over the median time; 0 before the first."""
        return 1 / max(statistics.median(self._seconds), 1e-9) if self._seconds else 0.0
