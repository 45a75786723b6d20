"""Find where surfels start."""

from dataclasses import replace
from functools import partial

from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.training.settings import StartParams


@stage(version=10, by_device=True)
def start(views: Views, masks: Masks, model: SparseModel, params: StartParams, job: Job) -> Start:
    """Find the object in masks, by a first look or by stereo, and lay surfels on it."""
    import torch

    from refdgs_pipe.sfm.ball import masked_ball
    from refdgs_pipe.training.begin import Begun, begin
    from refdgs_pipe.training.budget import start_within

    views = masks.applied(views, model.names)
    if masks.names:  # the ball of photos without masks is a guess
        model = replace(model, ball=masked_ball(model.cameras, views, model.ball))
    torch.set_num_threads(job.threads)

    def make(chosen: StartParams) -> Begun:
        looking = partial(job.progress, "looking for a start")
        return begin(views, model, chosen, job.scratch, device=job.device, progress=looking)

    found = start_within(make, params, job.warn)
    if found.stereo:
        job.measure("start", "what neighbouring photos agree on")
    if found.top:
        job.measure("top of the object", found.top)
    job.measure("surfels", len(found.start.geometry["means"]))
    return found.start
