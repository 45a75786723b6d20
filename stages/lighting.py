"""Find out whether the light stands still with the object."""

from functools import partial

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.lighting.settings import LightingParams
from refdgs_pipe.pipeline.stage import Job, stage


@stage(version=2, programs=("opencv-contrib-python-headless",))
def lighting(views: Views, model: SparseModel, params: LightingParams, job: Job) -> Lighting:
    """Tell light that stands still from a turntable's and a flash's."""
    from refdgs_pipe.lighting.decide import decide, gather
    from refdgs_pipe.sfm.support import support_plane

    plane = support_plane(model.points, model.ball.center, model.ball.radius, model.up)
    ground = None if plane is None else (plane.normal, plane.offset)
    evidence = gather(views, model, ground, partial(job.progress, "looking at the light"))
    found = decide(evidence, model, params.kind)
    job.measure("light", found.kind)
    if found.kind != "world":
        how = "a flash on the camera" if found.kind == "flash" else "a turntable in a still room"
        job.warn(
            f"the light moves as with {how}: {found.reason}. It is trained so; if that is wrong, "
            "set lighting.kind=world"
        )
    job.measure("because", found.reason)
    rings = evidence.rings
    job.measure("photos in rings", round(0.0 if rings is None else rings.share, 3), "share")
    job.measure("background that stands still", round(evidence.still, 3), "share of its texture")
    if evidence.slope is not None:
        job.measure("ground darkens away from the camera", round(evidence.slope, 3), "1: by a lamp")
    if evidence.explained is not None:
        job.measure("ground's changes that a lamp explains", round(evidence.explained, 3), "share")
    return found
