"""Fit a Ref-DGS field to the photos."""

from dataclasses import replace
from functools import partial

from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.training.settings import TrainParams


@stage(version=14, programs=("pymeshlab", "open3d-cpu"))
def train(
    views: Views, masks: Masks, model: SparseModel, params: TrainParams, job: Job
) -> SurfelField:
    """Optimise geometry, local reflection and background surfels and the shader."""
    import torch

    from refdgs_pipe.sfm.ball import masked_ball
    from refdgs_pipe.surface.own import own_surface
    from refdgs_pipe.training.budget import Load, planned, train_within
    from refdgs_pipe.training.coverage import doubt
    from refdgs_pipe.training.ground import ground_below
    from refdgs_pipe.training.render import render_surface_map
    from refdgs_pipe.training.trainer import Figures, Trainer

    def surface(field: SurfelField) -> Mesh:
        draw = partial(render_surface_map, field, device=job.device, threads=job.threads)
        placed = model.placed(field.poses)
        return own_surface(placed, draw, ground_below(placed, field), job.track, job.stop)

    views = masks.applied(views, model.names)
    if masks.names:  # the ball of photos without masks is a guess
        model = replace(model, ball=masked_ball(model.cameras, views, model.ball))

    def tell(step: int, steps: int, now: Figures, work: float) -> None:
        job.sample(step, steps, loss=now.loss, psnr=now.psnr, surfels=now.surfels)
        job.progress("training", step, steps, now.words, work)

    looking = partial(job.progress, "looking for a start")
    torch.set_num_threads(job.threads)
    load = Load(params, job.cuda_graph)
    load = planned(load, model, vram=job.vram, warn=job.warn) if job.device == "cuda" else load
    given = partial(Trainer, views, model, scratch=job.scratch, device=job.device, warn=job.warn)
    trainer, field = train_within(
        lambda x: given(x.params, cuda_graph=x.cuda_graph, starting=looking, surface=surface),
        load,
        tell,
        job.warn,
    )
    shown = trainer.coverage(field)
    if warning := doubt(shown, masked=trainer.masked):
        job.warn(warning)
    job.measure("object shown", round(100 * shown, 1), "%")
    for name, value, unit in trainer.figures(field):
        job.measure(name, value, unit)
    return field
