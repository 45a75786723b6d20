"""Find the object in photos that came without masks."""

from functools import partial

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.masking.settings import MasksParams
from refdgs_pipe.pipeline.stage import Job, stage


@stage(version=50, programs=("opencv-contrib-python-headless", "scipy"))
def masks(
    views: Views, model: SparseModel, lighting: Lighting, params: MasksParams, job: Job
) -> Masks:
    """Tell the object from what it stands on and from the room, in all photos together."""
    import torch

    from refdgs_pipe.masking.by_network import network_masks
    from refdgs_pipe.masking.files import write_masks
    from refdgs_pipe.masking.finding import agreement, object_masks, warnings_of
    from refdgs_pipe.masking.network import Network
    from refdgs_pipe.sfm.support import support_plane

    def none(reason: str) -> Masks:
        job.measure("masks", f"none: {reason}")
        return Masks(job.folder, (), "none", reason)

    if views.background != "photo":
        if params.model:
            job.warn("the photos came with masks, so the network of masks.model was not asked")
        return Masks(job.folder, (), "given")
    if params.find == "off":
        return none("masks.find is off")
    if params.model:
        answer = network_masks(views, model, Network.of(params), job.progress, job.stop)
        job.measure("network", params.network)
        job.measure("agreement of the masks", round(answer.agreement, 4), "of 1")
        for text in answer.warnings(params.agreement):
            job.warn(text)
        write_masks(job.folder, views, model, answer.masks)
        return Masks(job.folder, tuple(model.names), "network")
    plane = support_plane(model.points, model.ball.center, model.ball.radius, model.up)
    if plane is None:
        return none("the sparse points show no plane that the object stands on")
    torch.set_num_threads(1)  # photos are worked on side by side
    told = partial(job.progress, "finding the object")
    found = object_masks(views, model, plane.at, told, threads=job.threads, light=lighting)
    if found is None:
        return none("nothing stands on the plane that all photos agree on")
    mean, low = agreement(found)
    job.measure("agreement of the masks", round(mean, 4), "of 1")
    job.measure("agreement, worst tenth", round(low, 4), "of 1")
    if mean < params.agreement:
        return none(f"they agree by {mean:.1%} with one solid; {params.agreement:.1%} is asked for")
    for text in warnings_of(found):
        job.warn(text)
    write_masks(job.folder, views, model, found.masks)
    return Masks(job.folder, tuple(model.names), "found")
