"""Paint the mesh from the field: colour, roughness, metal and normals."""

from functools import partial

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.texture.settings import BakeParams


@stage(version=15, programs=("open3d-cpu", "scipy"), by_device=True)
def bake(
    mesh: UvMesh,
    looks: Appearance,
    field: SurfelField,
    model: SparseModel,
    views: Views,
    masks: Masks,
    params: BakeParams,
    job: Job,
) -> TexturedMesh:
    """Gather what all cameras see of every texel, free of reflections; then look at the photos."""
    from refdgs_pipe.artifacts.photos import load_photo
    from refdgs_pipe.texture.detail import close_ups, detailed
    from refdgs_pipe.texture.material import Painter
    from refdgs_pipe.texture.refining import refined
    from refdgs_pipe.texture.trust import expected_errors
    from refdgs_pipe.training.render import render_surface_map

    model = model.placed(field.poses, field.ball)
    views, cameras = masks.applied(views, model.names), model.training_cameras
    load = partial(load_photo, views, model)
    draw = partial(render_surface_map, field, device=job.device, threads=job.threads)
    tolerance = params.tolerance * 2 * model.ball.radius
    painter = Painter(mesh, params.painted_size, tolerance=tolerance)
    for camera in job.track(model.cameras, "gathering texels"):
        painter.add(draw(camera))
    textured = painter.paint(looks, expected_errors(mesh, cameras, load, draw, job.track))
    job.measure("texture size", params.size, "px")
    job.measure("texels seen", round(painter.seen_share, 4))
    if painter.seen_share < 0.9:
        unseen = f"{1 - painter.seen_share:.0%} of the surface was seen by no camera"
        job.warn(f"{unseen}; its colours are filled in from beside it")
    if params.refine and looks.environment is not None:
        photos = map(load, job.track(cameras, "comparing with photos"))
        textured = refined(textured, looks, photos, near=tolerance, count=len(cameras))
    if not params.detail:
        return textured
    sharp = partial(close_ups, mesh, load, params.size, model.ball)
    detail = partial(detailed, size=params.size, near=tolerance, threads=job.threads)
    return detail(textured, looks, sharp, cameras, job.track)
