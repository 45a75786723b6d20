"""Compare the field and its mesh with held-out photos, and with ground truth if there is any."""

from dataclasses import replace
from functools import partial

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.capture import Capture
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.artifacts.scores import Scores
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.evaluation.settings import EvaluateParams
from refdgs_pipe.pipeline.stage import Job, stage


@stage(version=16, programs=("open3d-cpu", "scipy"), by_device=True)
def evaluate(
    capture: Capture,
    views: Views,
    masks: Masks,
    model: SparseModel,
    field: SurfelField,
    mesh: Mesh,
    textured: TexturedMesh,
    looks: Appearance,
    params: EvaluateParams,
    job: Job,
) -> Scores:
    """Score every held-out view (all, if none was held out), the fitted mesh and its textures."""
    from refdgs_pipe.evaluation.lpips import load_lpips
    from refdgs_pipe.evaluation.scoring import Drawing, Protocol, Subject, score
    from refdgs_pipe.evaluation.speed import Timed
    from refdgs_pipe.relight import relit
    from refdgs_pipe.sfm.gaps import lowest_height
    from refdgs_pipe.training.ground import ground_below
    from refdgs_pipe.training.render import render_image, render_surface_map

    picture = Timed(partial(render_image, field, device=job.device, threads=job.threads))
    maps = partial(render_surface_map, field, device=job.device, threads=job.threads)
    lpips = load_lpips(params.lpips_weights, params.lpips_digest)
    protocol = Protocol(params.max_side, lpips, lambda c: job.track(c, "comparing views"))
    views = masks.applied(views, model.names)
    model = model.placed(field.poses, field.ball)
    ground = ground_below(model, field)
    stands, lowest = masks.kind == "found", lowest_height(model)
    subject = Subject(views, model, mesh, capture.layout().root, textured, ground, stands, lowest)
    asset = relit(textured, looks, threads=job.threads)
    scores = score(subject, Drawing(picture, maps, asset), protocol)
    for name, value, unit in scores.headlines():
        job.measure(name, value, unit)
    job.measure("render rate", round(picture.per_second, 2), "views/s")
    job.measure("rendered", f"{picture.told} on {job.device}, threads: {job.threads}")
    parts = {"geometry": field.geometry, "local": field.local, "background": field.background}
    return replace(scores, surfels={name: len(part) for name, part in parts.items()})
