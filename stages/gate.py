"""Judge the photos' places by evidence, and find the ball that the object lives in."""

from refdgs_pipe.artifacts.placement import Placement
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.sfm.settings import GateParams


@stage(version=13, programs=("opencv-contrib-python-headless",))
def gate(views: Views, placement: Placement, params: GateParams, job: Job) -> SparseModel:
    """Keep the photos whose places can be trusted; poses that came with them are kept."""
    from refdgs_pipe.sfm.gate import check_trusted, examine
    from refdgs_pipe.sfm.known import model_from_known_poses
    from refdgs_pipe.sfm.on_ground import evened, judged_on_ground
    from refdgs_pipe.sfm.report import figures, overridden, warnings_about
    from refdgs_pipe.sfm.two_points import with_distance

    gaps: tuple[str, ...] = ()
    if placement.known:
        model = model_from_known_poses(views, placement.poses)
    else:
        judgement = examine(views, placement, least=params.min_trusted)
        if params.ground:
            least = params.min_trusted
            judgement, laid = judged_on_ground(
                views, placement, judgement, job.progress, least=least, threads=job.threads
            )
            for name, value in () if laid is None else laid.figures():
                job.measure(name, value)
        for check in judgement.checks:
            job.measure(check.name, check.found)
        model = check_trusted(views, judgement, attempts=len(placement.attempts))
        gaps = judgement.gaps
    model = overridden(model, params.up, params.ball_center, params.ball_radius)
    model = with_distance(model, views, params.distance)
    model = evened(views, model, job.threads) if params.even else model
    for name, value, unit in figures(model, placement.poses):
        job.measure(name, value, unit)
    for note in placement.notes:
        job.measure("note", note)
    for text in (*warnings_about(views, model, known=placement.known), *gaps):
        job.warn(text)
    return model
