"""Compare the field with photos that were held out."""

from pydantic import Field

from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class EvaluateParams(Params):
    """How the field is scored."""

    max_side: int = Field(800, ge=32, le=8192, description="longest image side compared, in pixels")


@stage(version=1)
def evaluate(
    views: Views, model: SparseModel, field: SurfelField, params: EvaluateParams, job: Job
) -> Scores:
    """PSNR and SSIM of every held-out view; of all views if none was held out."""
    from refdgs_pipe.training.scoring import score_field

    largest = max(max(camera.width, camera.height) for camera in model.cameras)
    scores = score_field(
        views,
        model,
        field,
        scale=min(1.0, params.max_side / largest),
        device=job.device,
        track=lambda cameras: job.track(cameras, "comparing with photos"),
    )
    kind = "held-out" if scores.split == "test" else "training"
    job.measure(f"PSNR of {kind} views", round(scores.psnr, 2), "dB")
    job.measure(f"SSIM of {kind} views", round(scores.ssim, 4))
    return scores
