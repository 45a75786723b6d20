"""The inside of a vessel, which training keeps empty.

Nothing holds a plain surface in place that no outline shows, such as a vessel's inside. Discs that
float before it hide those behind, which then get no gradient and fade. So such a surface moves
towards the cameras. Where the start has found a hollow, discs that float in it are moved back.
"""

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.start import HOLLOW, SOLID, U8
from refdgs_pipe.training.initial import hull_ticks


class Hollow:
    """Where a vessel is empty, and the way back to its solid part.

    Args:
        vessel: (n, n, n) of `Start`; ball: its cells lie in.
    """

    def __init__(self, vessel: U8, ball: Ball, device: str = "cpu") -> None:
        ticks = hull_ticks(ball, len(vessel))
        self._cell = float(ticks[1] - ticks[0])
        self._low = torch.tensor(ball.center + ticks[0], dtype=torch.float32, device=device)
        nearest = distance_transform_edt(
            vessel != SOLID, return_distances=False, return_indices=True
        )
        back = (nearest - np.indices(vessel.shape)).transpose(1, 2, 3, 0) * self._cell
        back[vessel != HOLLOW] = 0
        self._back = torch.from_numpy(back.astype(np.float32)).to(device)

    def kept_empty(self, means: Tensor) -> Tensor:
        """Centres (N, 3), world; those that float in the hollow are moved to the nearest wall."""
        n = len(self._back)
        at = ((means - self._low) / self._cell).round().long()
        within = ((at >= 0) & (at < n)).all(1, keepdim=True)
        i, j, k = at.clamp(0, n - 1).unbind(1)
        return means + self._back[i, j, k] * within
