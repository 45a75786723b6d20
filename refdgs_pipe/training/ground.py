"""The level surface that the object of photos stands on, as the sparse points show it."""

import numpy as np
import torch
from torch import Tensor

from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.camera import F64
from refdgs_pipe.geometry import one_sided

NEAR = 2.5  # points farther from the ball's centre do not vote, in ball radii
THICK = 0.01  # either side of the plane, in ball radii
LEAST = 30  # points on it
_STRAY = 0.01  # of the object's surfels, that may lie lower than a ground that is not its own
SHARE = 0.15  # of the points near by, that must lie on it


class Surroundings:
    """What is the object's and what is not: a ball, and the ground through the world's origin.

    In the world of photos the origin lies on the support. Where sparse points do not say that
    there is a surface, there is none, and the ball alone counts.
    """

    def __init__(self, model: SparseModel, *, ground: bool) -> None:
        self.ball: Ball = model.ball
        self.up: F64 | None = model.up if ground and _holds_points(model) else None

    def near(self, points: Tensor, margin: float) -> Tensor:
        """(N,) whether points (N, 3) lie in the ball, made larger by a factor."""
        center = torch.tensor(self.ball.center, dtype=points.dtype, device=points.device)
        near: Tensor = (points - center).norm(dim=-1) <= margin * self.ball.radius
        return near

    def above(self, points: Tensor) -> Tensor:
        """(N,) whether points (N, 3) are no part of the ground, nor below it."""
        if self.up is None:
            return torch.ones(len(points), dtype=torch.bool, device=points.device)
        up = torch.tensor(self.up, dtype=points.dtype, device=points.device)
        return points @ up > THICK * self.ball.radius

    def objects(self, points: Tensor, margin: float = 1.0) -> Tensor:
        """(N,) whether points (N, 3) can be the object's."""
        return self.near(points, margin) & self.above(points)


def ground_below(model: SparseModel, field: SurfelField) -> F64 | None:
    """(3,) unit normal of the ground through the world's origin, where a field has none of it.

    None where the ground is not known or part of the field, and for photos from one side: what
    no photo sees is then not the object's inside.
    """
    if not _holds_points(model) or one_sided(model.cameras, model.ball.center, model.up):
        return None
    return model.up if not len(field.background) or left_to_background(model, field) else None


def left_to_background(model: SparseModel, field: SurfelField) -> bool:
    """Whether a field has the ground among its background, so that no mesh of it holds any."""
    lower = field.geometry.means @ model.up <= THICK * model.ball.radius
    return len(field.background) > 0 and _holds_points(model) and float(lower.mean()) < _STRAY


def _holds_points(model: SparseModel) -> bool:
    """Whether enough sparse points lie on the level plane through the origin."""
    radius = model.ball.radius
    distance = np.linalg.norm(model.points - model.ball.center, axis=1)
    heights = model.points[distance < NEAR * radius] @ model.up
    on = int((np.abs(heights) < THICK * radius).sum())
    return on >= max(LEAST, SHARE * len(heights))
