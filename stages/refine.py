"""Let surfels start anew on the field's own mesh, and train to the end."""

from dataclasses import replace
from functools import partial

from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.shape import Shape
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.training.settings import RefineParams


@stage(version=2, by_device=True)
def refine(
    views: Views,
    masks: Masks,
    model: SparseModel,
    lighting: Lighting,
    start: Start,
    before: Checkpoint,
    shape: Shape,
    params: RefineParams,
    job: Job,
) -> SurfelField:
    """Go on from the checkpoint with surfels on the mesh; pass a field that is finished on."""
    import torch

    from refdgs_pipe.training.budget import Load, train_part
    from refdgs_pipe.training.checkpoint import settings_of
    from refdgs_pipe.training.coverage import doubt
    from refdgs_pipe.training.figures import teller, told_figures
    from refdgs_pipe.training.renewal import Renewal
    from refdgs_pipe.training.trainer import Trainer

    torch.set_num_threads(job.threads)
    views, start = masks.applied(views, model.names), replace(start, max_side=before.max_side)

    part = partial(Trainer, views, model, scratch=job.scratch, device=job.device, warn=job.warn)
    part = partial(part, lighting=lighting)

    def make(x: Load) -> Trainer:
        anew = Renewal(shape.mesh, shape.why_not, params.surfels, x.most, params.turning)
        return part(x.start, x.params, after=before, renewal=anew, cuda_graph=x.cuda_graph)

    load = Load(settings_of(before), start, job.cuda_graph, growth=params.surfels)
    how = (job.device, job.vram, teller(job.sample, job.progress), job.warn)
    done = before if before.is_last else train_part(make, load, model, *how)
    if warning := doubt(done.shown, masked=views.background != "photo"):
        job.warn(warning)
    job.measure("object shown", round(100 * done.shown, 1), "%")
    for name, value, unit in told_figures(done.figures, done.field):
        job.measure(name, value, unit)
    return done.field
