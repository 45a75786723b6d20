"""How much of the object a finished field shows."""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.camera import Camera
from refdgs_pipe.training.render import render_surface_map

F32 = NDArray[np.float32]


def coverage(
    field: SurfelField,
    cameras: list[Camera],
    masks: list[F32] | None,
    ball: Ball,
    *,
    device: str = "cpu",
) -> float:
    """How much of the object a field shows, 0 to 1: the mean over views of intersection over union.

    Args:
        masks: (H, W) for each camera, at its size; None: nothing is known, and the share of the
            ball's disc that the object fills is returned.
    """
    shares = []
    for index, camera in enumerate(cameras):
        alpha = render_surface_map(field, camera, device=device).alpha
        if masks is not None:
            both, either = np.minimum(alpha, masks[index]), np.maximum(alpha, masks[index])
            shares.append(float(both.sum() / max(float(either.sum()), 1.0)))
            continue
        uv, depth = camera.project(ball.center[None])
        radius = float(camera.K[0, 0]) * ball.radius / max(float(depth[0]), 1e-9)
        ys, xs = np.mgrid[: camera.height, : camera.width] + 0.5
        disc = (xs - uv[0, 0]) ** 2 + (ys - uv[0, 1]) ** 2 < radius**2
        shares.append(float((alpha * disc).sum() / max(int(disc.sum()), 1)))
    return float(np.mean(shares))
