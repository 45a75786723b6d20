"""Fit a Ref-DGS field to the photos."""

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.training.settings import TrainParams

LEAST_OVERLAP = 0.6  # of masks and field
LEAST_FILL = 0.02  # of the object ball's disc, where there are no masks


@stage(version=6)
def train(views: Views, model: SparseModel, params: TrainParams, job: Job) -> SurfelField:
    """Optimise geometry, local reflection and background surfels and the shader."""
    import torch

    from refdgs_pipe.training.budget import planned, train_within
    from refdgs_pipe.training.trainer import Trainer

    def starting(done: int, total: int) -> None:
        job.progress("looking for a start", done, total)

    torch.set_num_threads(job.threads)
    if job.device == "cuda":
        params = planned(params, model, vram=job.vram, warn=job.warn)
    trainer, field = train_within(
        lambda p: Trainer(
            views, model, p, job.scratch, device=job.device, warn=job.warn, starting=starting
        ),
        params,
        lambda done, total, note, work: job.progress("training", done, total, note, work),
        job.warn,
    )
    shown = trainer.coverage(field)
    if shown < (LEAST_OVERLAP if trainer.masked else LEAST_FILL):
        job.warn(
            f"the field shows only {shown:.0%} of "
            + ("what the masks cover" if trainer.masked else "the object's surroundings")
            + ": the object may be lost. Look at `refdgs-pipe render WORKSPACE`, give masks, more "
            "photos or more train.iterations"
        )
    job.measure("object shown", round(100 * shown, 1), "%")
    job.measure("steps", trainer.iteration)
    if trainer.early:
        job.measure("stopped early", trainer.early)
    job.measure("loss", round(trainer.loss, 5))
    job.measure("train PSNR", round(trainer.psnr, 2), "dB")
    job.measure("surfels", len(field.geometry))
    job.measure("local surfels", len(field.local))
    job.measure("background surfels", len(field.background))
    return field
