"""What the user may say about a sparse model, and what is said to the user."""

from dataclasses import replace

import numpy as np

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.artifacts.sparse_model import Ball, SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.sfm.frame import turned_up

NAMES_SHOWN = 8
FEW_POINTS = 40  # seen by a photo; 12 photos 20 degrees apart had 25, and wrong places


def overridden(
    model: SparseModel,
    up: tuple[float, float, float] | None,
    center: tuple[float, float, float] | None,
    radius: float | None,
) -> SparseModel:
    """The model with what the user set, given in the frame of `model`.

    Photos are turned so that `up` becomes z; the frame of known poses is never changed.
    """
    ball = model.ball
    where = ball.center if center is None else np.array(center, float)
    model = replace(model, ball=Ball(where, ball.radius if radius is None else radius))
    if up is None:
        return model
    direction = np.array(up, float) / max(float(np.linalg.norm(up)), 1e-12)
    if np.array_equal(model.sfm_from_world, np.eye(4)):
        return replace(model, up=direction)
    return turned_up(replace(model, up=direction))


def figures(model: SparseModel, poses: Poses | None) -> list[tuple[str, float | int | str, str]]:
    """(name, value, unit) of what there is to know about a model at a glance."""
    total = len(model.cameras) + len(model.lost)
    center = ", ".join(f"{value:.3f}" for value in model.ball.center)
    out: list[tuple[str, float | int | str, str]] = [
        ("registered", f"{len(model.cameras)} of {total}", ""),
        ("points", len(model.points), ""),
        ("focal length", float(np.median([camera.K[0, 0] for camera in model.cameras])), "px"),
        ("ball centre", center, "units"),
        ("ball radius", model.ball.radius, "units"),
    ]
    if model.gains:
        factors = np.array(list(model.gains.values())).mean(1)
        stops = float(np.abs(np.log2(factors)).max())
        out.append(("exposure evened, at most", stops, "stops"))
    if poses is not None:
        out += [("reprojection error", poses.error_px, "px"), ("mapper", poses.mapper, "")]
    return out


def warnings_about(views: Views, model: SparseModel, *, known: bool) -> list[str]:
    """The photos that found no place, and whether the others hang together by little.

    Args:
        known: whether the poses came with the photos.
    """
    said = {view.name: view.source or view.name for view in views.items}
    weak = []
    seen = [len(points) for points in model.tracks.values()]
    if seen and np.median(seen) < FEW_POINTS:
        half = f"half of the photos show {int(np.median(seen))} or fewer"
        weak.append(
            f"few points fit the poses that came with the photos ({half}): the poses may be wrong. "
            "Run on the photos without the file of poses, or give masks of the object"
            if known
            else f"the photos share few features ({half}): their places are uncertain. Closer "
            "steps between photos help, and a textured ground"
        )
    if not model.lost:
        return weak
    total = len(model.lost) + len(model.cameras)
    listed = "; ".join(f"{said[view.name]}: {view.reason}" for view in model.lost[:NAMES_SHOWN])
    rest = len(model.lost) - NAMES_SHOWN
    more = f"; and {rest} more" if rest > 0 else ""
    told = f"{len(model.lost)} of {total} photos have no trusted place and are left out. "
    return [*weak, told + listed + more]
