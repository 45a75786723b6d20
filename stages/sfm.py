"""Find where every photo was taken, and the ball that the object lives in."""

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class SfmParams(Params):
    """Structure from motion."""


@stage(version=1, programs=("pycolmap",))
def sfm(views: Views, params: SfmParams, job: Job) -> SparseModel:
    """Pose the photos; poses that came with them are kept."""
    from refdgs_pipe.sfm.known import model_from_known_poses

    model = model_from_known_poses(views)
    job.measure("registered", f"{len(model.cameras)} of {len(views.items)}")
    job.measure("ball radius", model.ball.radius, "units")
    return model
