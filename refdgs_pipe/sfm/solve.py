"""Which features may count, tried in turn until enough photos are placed."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.sfm.pictures import MaskUse, feature_masks, plain_images
from refdgs_pipe.sfm.posed import shots_of
from refdgs_pipe.sfm.poses import Effort, Poses

GOOD = 0.9  # share of photos placed that ends the trials


def solve(
    views: Views,
    effort: Effort,
    *,
    masks: MaskUse | Literal["auto"],
    scratch: Path,
    run: Callable[[dict[str, Any]], Poses | None],
) -> Poses | None:
    """The poses of the attempt that placed most photos; None if none found a start.

    Around a still object the background helps, on a turntable it misleads: with `masks` "auto"
    everything counts at first, then only the object, then only the background.

    Args:
        run: calls `colmap.reconstruct` with these arguments, in a process of its own.
    """
    images = plain_images(views, scratch)
    uses: tuple[MaskUse, ...] = ("none", "object", "background") if masks == "auto" else (masks,)
    if views.background == "photo":
        uses = ("none",)
    best: Poses | None = None
    for use in uses:
        arguments = {
            "images": images,
            "shots": shots_of(views),
            "masks": feature_masks(views, use, scratch),
            "effort": effort,
            "scratch": scratch / f"colmap-{use}",
        }
        poses = run(arguments)
        if best is None or (poses is not None and _placed(poses) > _placed(best)):
            best = poses
        if _placed(best) >= GOOD * len(views.items):
            break
    return best


def _placed(poses: Poses | None) -> int:
    return 0 if poses is None else len(poses.cam_from_world)
