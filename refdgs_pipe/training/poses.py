"""Small corrections of the cameras' poses, learnt with the field."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.camera import Camera

F64 = NDArray[np.float64]


class Poses:
    """How far each camera is from where it was said to be; nowhere at the start.

    A pose is multiplied from the right by a rigid motion of the world, the exponential of six
    numbers: a turn about the ball's centre in radians, and a shift in units of the cameras' median
    distance from it, so that equal numbers move the picture by about as much.

    What all cameras have in common, to first order (three turns, three shifts, and the world's
    growth about the ball's centre), is taken out after each update: the field could follow such a
    motion unseen, and would leave the cameras that are not corrected, the held-out ones.

    Args:
        cameras: those that are corrected.
        rate: Adam's step, each time that a camera's photo is trained on.
    """

    def __init__(self, cameras: Sequence[Camera], ball: Ball, rate: float) -> None:
        away = np.stack([camera.center for camera in cameras]) - ball.center
        self._distance = float(np.median(np.linalg.norm(away, axis=1)))
        self._center = torch.from_numpy(np.asarray(ball.center, np.float64))
        self._given = {
            camera.name: torch.from_numpy(np.array(camera.cam_from_world)) for camera in cameras
        }
        self._all = torch.zeros(len(cameras), 6, dtype=torch.float64)
        rows = [self._all[i].requires_grad_() for i in range(len(cameras))]
        self._moves = dict(zip(self._given, rows, strict=True))
        self._common = _common_motions(away / self._distance)
        self.optimizer = torch.optim.Adam(rows, lr=rate, eps=1e-15)

    def pose(self, name: str) -> Tensor:
        """(4, 4) float64 cam_from_world of a camera as corrected, with a gradient."""
        move = self._moves[name]
        turn, shift = move[:3], move[3:] * self._distance
        x, y, z = turn.unbind()
        zero = torch.zeros_like(x)
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
        rotation = torch.linalg.matrix_exp(skew)
        shift = self._center - rotation @ self._center + shift
        top = torch.cat([rotation, shift[:, None]], 1)
        return self._given[name] @ torch.cat([top, top.new_tensor([[0.0, 0, 0, 1]])])

    def strangeness(self, name: str) -> Tensor:
        """() the sum of a camera's squared six numbers."""
        return self._moves[name].square().sum()

    def step(self, *, changes: bool = True) -> None:
        """One update, if it `changes` anything, of the cameras that have a gradient; cleared."""
        if changes:
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            flat = self._all.flatten()
            self._all -= (self._common @ (self._common.T @ flat)).reshape_as(self._all)

    def found(self) -> dict[str, F64]:
        """Camera's name -> (4, 4) cam_from_world as corrected."""
        return {name: self.pose(name).detach().numpy() for name in self._given}

    def state(self) -> dict[str, Tensor]:
        """Everything needed to continue."""
        out = {"moves": self._all.clone()}
        for i, row in enumerate(self._moves.values()):
            out |= {f"{i}/{k}": v for k, v in self.optimizer.state.get(row, {}).items()}
        return out

    def restore(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state`."""
        with torch.no_grad():
            self._all.copy_(state["moves"])
        for i, row in enumerate(self._moves.values()):
            prefix = f"{i}/"
            moments = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
            if moments:
                self.optimizer.state[row] = {k: v.clone() for k, v in moments.items()}


def _common_motions(away: F64) -> Tensor:
    """(6 P, K) orthonormal: the motions of all cameras at once that no picture shows.

    Args:
        away: (P, 3) from the ball's centre to each camera.
    """
    each = np.tile(np.eye(6), (len(away), 1))
    growth = np.concatenate([np.zeros_like(away), away], 1).reshape(-1, 1)
    vectors, sizes, _ = np.linalg.svd(np.concatenate([each, growth], 1), full_matrices=False)
    return torch.from_numpy(vectors[:, sizes > 1e-9 * sizes[0]])
