"""Judge the photos' places by evidence, and find the ball that the object lives in."""

from pydantic import Field

from refdgs_pipe.artifacts.placement import Placement
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage

Point = tuple[float, float, float]


class GateParams(Params):
    """What is asked of the places. A given up axis or ball is in the frame of the result."""

    min_trusted: float = Field(
        0.7, ge=0, le=1, description="share of the photos that need a trusted place"
    )
    up: Point | None = Field(None, description="up axis, a direction; none finds it")
    ball_center: Point | None = Field(None, description="object ball's centre, world units")
    ball_radius: float | None = Field(None, gt=0, description="object ball's radius, world units")
    distance: str = Field(
        "",
        max_length=2000,
        description="two points marked in photos, in pixels, and metres between them; empty: none",
    )


@stage(version=2)
def gate(views: Views, placement: Placement, params: GateParams, job: Job) -> SparseModel:
    """Keep the photos whose places can be trusted; poses that came with them are kept."""
    from refdgs_pipe.sfm.gate import check_trusted, examine
    from refdgs_pipe.sfm.known import model_from_known_poses
    from refdgs_pipe.sfm.report import figures, overridden, warnings_about
    from refdgs_pipe.sfm.two_points import with_distance

    gaps: tuple[str, ...] = ()
    if placement.known:
        model = model_from_known_poses(views)
    else:
        judgement = examine(views, placement, least=params.min_trusted)
        for check in judgement.checks:
            job.measure(check.name, check.found)
        model = check_trusted(views, judgement, attempts=len(placement.attempts))
        gaps = judgement.gaps
    model = overridden(model, params.up, params.ball_center, params.ball_radius)
    model = with_distance(model, views, params.distance)
    for name, value, unit in figures(model, placement.poses):
        job.measure(name, value, unit)
    for note in placement.notes:
        job.measure("note", note)
    for text in (*warnings_about(views, model), *gaps):
        job.warn(text)
    return model
