"""Judge the photos' places by evidence, and find the ball that the object lives in."""

from functools import partial

from refdgs_pipe.artifacts.placement import Placement
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.sfm.settings import GateParams


@stage(version=10, programs=("opencv-contrib-python-headless",))
def gate(views: Views, placement: Placement, params: GateParams, job: Job) -> SparseModel:
    """Keep the photos whose places can be trusted; poses that came with them are kept."""
    from refdgs_pipe.sfm.gate import check_trusted, examine
    from refdgs_pipe.sfm.known import model_from_known_poses
    from refdgs_pipe.sfm.report import figures, overridden, warnings_about
    from refdgs_pipe.sfm.two_points import with_distance

    gaps: tuple[str, ...] = ()
    if placement.known:
        model = model_from_known_poses(views, placement.poses)
    else:
        judgement = examine(views, placement, least=params.min_trusted)
        for check in judgement.checks:
            job.measure(check.name, check.found)
        model = check_trusted(views, judgement, attempts=len(placement.attempts))
        model = _on_the_ground(views, model, job) if params.ground else model
        gaps = judgement.gaps
    model = overridden(model, params.up, params.ball_center, params.ball_radius)
    model = with_distance(model, views, params.distance)
    for name, value, unit in figures(model, placement.poses):
        job.measure(name, value, unit)
    for note in placement.notes:
        job.measure("note", note)
    for text in (*warnings_about(views, model, known=placement.known), *gaps):
        job.warn(text)
    return model


def _on_the_ground(views: Views, model: SparseModel, job: Job) -> SparseModel:
    """The model with poses refined on the plane that the object stands on."""
    import numpy as np

    from refdgs_pipe.ground.register import registered
    from refdgs_pipe.sfm.support import support_plane

    plane = support_plane(model.points, model.ball.center, model.ball.radius, model.up)
    if plane is None:
        return model
    told = partial(job.progress, "refining poses on the ground plane")
    found = registered(views, model, (plane.normal, plane.offset), told, job.threads)
    if found is None:
        return model
    before, after = np.median(list(found.misses.values()), axis=0)
    job.measure("poses refined on the ground plane", f"{len(found.misses)} of {len(model.cameras)}")
    job.measure("distance from the ground's texture", f"{before:.2f} px, then {after:.2f} px")
    return found.model
