"""Fit a Ref-DGS field to the photos, up to where surfels start anew."""

from functools import partial

from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.training.settings import TrainParams


@stage(version=18, by_device=True)
def train(
    views: Views,
    masks: Masks,
    model: SparseModel,
    lighting: Lighting,
    start: Start,
    params: TrainParams,
    job: Job,
) -> Checkpoint:
    """Optimise geometry, local reflection and background surfels and the shader."""
    import torch

    from refdgs_pipe.training.budget import Load, train_part
    from refdgs_pipe.training.figures import teller, told_figures
    from refdgs_pipe.training.near_trial import settled
    from refdgs_pipe.training.trainer import Trainer

    views = masks.applied(views, model.names)
    torch.set_num_threads(job.threads)

    trying = partial(job.progress, "trying near-field features")
    params, trial = settled(
        params, views, model, start, job.scratch, lighting=lighting, progress=trying
    )
    if trial is not None:
        job.measure("near-field features", trial.words)

    part = partial(Trainer, views, model, scratch=job.scratch, device=job.device, warn=job.warn)

    def make(x: Load) -> Trainer:
        return part(x.start, x.params, lighting=lighting, cuda_graph=x.cuda_graph)

    load = Load(params, start, job.cuda_graph)
    how = (job.device, job.vram, teller(job.sample, job.progress), job.warn)
    done = train_part(make, load, model, *how)
    for name, value, unit in told_figures(done.figures, done.field):
        job.measure(name, value, unit)
    return done
