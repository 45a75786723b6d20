"""Paint the mesh from the field: colour, roughness, metal and normals."""

from pydantic import Field

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.params import Params, PowerOfTwo
from refdgs_pipe.pipeline.stage import Job, stage


class BakeParams(Params):
    """The textures."""

    size: PowerOfTwo = Field(
        2048, ge=64, le=8192, description="texels along a side; a power of two"
    )
    tolerance: float = Field(
        0.01, gt=0, le=0.2, description="largest gap of mesh and field, in ball diameters"
    )
    refine: bool = Field(True, description="correct base colours by the photos, in the light found")


@stage(version=10, programs=("open3d-cpu", "scipy"), by_device=True)
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
    from refdgs_pipe.texture.material import Painter
    from refdgs_pipe.texture.refining import refined
    from refdgs_pipe.training.render import render_surface_map

    model = model.placed(field.poses, field.ball)
    tolerance = params.tolerance * 2 * model.ball.radius
    painter = Painter(mesh, params.size, tolerance=tolerance)
    for camera in job.track(model.cameras, "gathering texels"):
        painter.add(render_surface_map(field, camera, device=job.device, threads=job.threads))
    textured = painter.paint(looks)
    job.measure("texture size", params.size, "px")
    job.measure("texels seen", round(painter.seen_share, 4))
    if painter.seen_share < 0.9:
        unseen = f"{1 - painter.seen_share:.0%} of the surface"
        job.warn(f"{unseen} was seen by no camera; its colours are filled in from beside it")
    if not params.refine or looks.environment is None:
        return textured
    views, cameras = masks.applied(views, model.names), model.training_cameras
    photos = (load_photo(views, model, c) for c in job.track(cameras, "comparing with photos"))
    return refined(textured, looks, photos, near=tolerance, count=len(cameras))
