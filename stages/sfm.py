"""Find where every photo was taken, and the ball that the object lives in."""

from typing import Any, Literal

from pydantic import Field

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage

Point = tuple[float, float, float]


class SfmParams(Params):
    """Structure from motion. A given up axis or ball is in the frame of the automatic result."""

    max_side: int = Field(1600, ge=100, le=16384, description="photos to this long side, in pixels")
    max_features: int = Field(8192, ge=100, le=65536, description="features per photo, a count")
    first_octave: int | None = Field(
        None, ge=-1, le=2, description="-1 doubles photos first, slower; none: if below 1000 pixels"
    )
    masks: Literal["auto", "object", "background", "none"] = Field(
        "auto", description="where features count; auto tries none, then object, then background"
    )
    min_registered: float = Field(0.7, ge=0, le=1, description="share of photos to be placed")
    up: Point | None = Field(None, description="up axis, a direction; none finds it")
    ball_center: Point | None = Field(None, description="object ball's centre, world units")
    ball_radius: float | None = Field(None, gt=0, description="object ball's radius, world units")


@stage(version=2, programs=("pycolmap",))
def sfm(views: Views, params: SfmParams, job: Job) -> SparseModel:
    """Pose the photos; poses that came with them are kept."""
    from refdgs_pipe.child import call_in_child
    from refdgs_pipe.sfm.known import model_from_known_poses
    from refdgs_pipe.sfm.posed import check_registered, model_from_poses
    from refdgs_pipe.sfm.poses import Effort
    from refdgs_pipe.sfm.report import figures, overridden, warnings_about
    from refdgs_pipe.sfm.solve import solve

    def run(arguments: dict[str, Any]) -> Any:
        target = "refdgs_pipe.sfm.colmap:reconstruct"
        return call_in_child(target, arguments, stop=job.stop, on_progress=job.progress)

    if views.has_known_poses:
        poses, model = None, model_from_known_poses(views)
    else:
        effort = Effort(params.max_side, params.max_features, params.first_octave, job.threads)
        found = solve(views, effort, masks=params.masks, scratch=job.scratch, run=run)
        poses = check_registered(views, found, least=params.min_registered)
        model = model_from_poses(views, poses)
    model = overridden(model, params.up, params.ball_center, params.ball_radius)
    for name, value, unit in figures(model, poses):
        job.measure(name, value, unit)
    for text in warnings_about(model):
        job.warn(text)
    return model
