"""Find the object in photos that came without masks."""

from functools import partial
from typing import Literal

from pydantic import Field

from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class MasksParams(Params):
    """Masks that are made from the photos themselves."""

    find: Literal["auto", "off"] = Field(
        "auto", description="auto: where the photos have none and all agree on one; or off"
    )
    agreement: float = Field(
        0.9,
        ge=0,
        le=1,
        description="masks that agree less with the solid that all of them show are not used "
        "(intersection over union)",
    )


@stage(version=1, programs=("opencv-contrib-python-headless", "scipy"))
def masks(views: Views, model: SparseModel, params: MasksParams, job: Job) -> Masks:
    """Tell the object from what it stands on and from the room, in all photos together."""
    import torch

    from refdgs_pipe.masking.files import write_masks
    from refdgs_pipe.masking.rounds import agreement, object_masks
    from refdgs_pipe.sfm.support import support_plane

    if views.background != "photo":
        return Masks(job.folder, (), "given")
    if params.find == "off":
        return Masks(job.folder, (), "none", "masks.find is off")
    plane = support_plane(model.points, model.ball.center, model.ball.radius, model.up)
    if plane is None:
        why = "the sparse points show no plane that the object stands on"
        job.measure("masks", f"none: {why}")
        return Masks(job.folder, (), "none", why)
    torch.set_num_threads(1)  # photos are worked on side by side
    told = partial(job.progress, "finding the object")
    found = object_masks(views, model, (plane.normal, plane.offset), told, job.threads)
    if found is None:
        why = "nothing stands on the plane that all photos agree on"
        job.measure("masks", f"none: {why}")
        return Masks(job.folder, (), "none", why)
    mean, low = agreement(found)
    job.measure("agreement of the masks", round(mean, 4), "of 1")
    job.measure("agreement, worst tenth", round(low, 4), "of 1")
    if mean < params.agreement:
        why = f"they agree by {mean:.0%} only with one solid, {params.agreement:.0%} are asked for"
        job.measure("masks", f"none: {why}")
        return Masks(job.folder, (), "none", why)
    write_masks(job.folder, views, model, found.masks)
    return Masks(job.folder, tuple(camera.name for camera in model.cameras), "found")
