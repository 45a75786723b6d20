"""How much of the object a finished field shows."""

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.camera import Camera
from refdgs_pipe.training.render import render_surface_map

F32 = NDArray[np.float32]

LEAST_OVERLAP = 0.6  # of masks and field
LEAST_FILL = 0.02  # of the object ball's disc, where there are no masks


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


def doubt(shown: float, *, masked: bool) -> str:
    """What to warn of, if a field shows too little of the object; "" if it shows enough.

    Args:
        shown: what `coverage` returned.
        masked: whether it compared with masks.
    """
    if shown >= (LEAST_OVERLAP if masked else LEAST_FILL):
        return ""
    return (
        f"the field shows only {shown:.0%} of "
        + ("what the masks cover" if masked else "the object's surroundings")
        + ": the object may be lost. Look at `refdgs-pipe render WORKSPACE`, give masks, more "
        "photos or more train.iterations"
    )
