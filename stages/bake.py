"""Paint the mesh from the field: colour, roughness, metal and normals."""

from collections.abc import Iterator
from itertools import islice

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.texture.settings import PAINTED_SIDE, BakeParams


@stage(version=12, programs=("open3d-cpu", "scipy"), by_device=True)
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
    from refdgs_pipe.artifacts.photos import Photo, load_photo
    from refdgs_pipe.texture.detail import PASSES, detailed, scale_for
    from refdgs_pipe.texture.material import Painter
    from refdgs_pipe.texture.refining import refined
    from refdgs_pipe.training.render import render_surface_map

    model = model.placed(field.poses, field.ball)
    tolerance = params.tolerance * 2 * model.ball.radius
    size = min(params.size, PAINTED_SIDE) if params.detail else params.size
    painter = Painter(mesh, size, tolerance=tolerance)
    for camera in job.track(model.cameras, "gathering texels"):
        painter.add(render_surface_map(field, camera, device=job.device, threads=job.threads))
    textured = painter.paint(looks)
    job.measure("texture size", params.size, "px")
    job.measure("texels seen", round(painter.seen_share, 4))
    if painter.seen_share < 0.9:
        unseen = f"{1 - painter.seen_share:.0%} of the surface"
        job.warn(f"{unseen} was seen by no camera; its colours are filled in from beside it")
    views, cameras = masks.applied(views, model.names), model.training_cameras
    if params.refine and looks.environment is not None:
        photos = (load_photo(views, model, c) for c in job.track(cameras, "comparing with photos"))
        textured = refined(textured, looks, photos, near=tolerance, count=len(cameras))
    if not params.detail:
        return textured
    rounds = job.track([*cameras] * PASSES, "taking detail from photos")

    def sharp() -> Iterator[Photo]:
        for camera in islice(rounds, len(cameras)):
            photo = load_photo(views, model, camera, scale=scale_for(mesh, params.size, camera))
            yield photo.framed(model.ball.center, model.ball.radius)

    return detailed(textured, looks, sharp, size=params.size, near=tolerance, threads=job.threads)
