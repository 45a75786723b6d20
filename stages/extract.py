"""Fuse the field's depth into one mesh."""

from refdgs_pipe.artifacts.mesh import RawMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.surface.settings import ExtractParams


@stage(version=4, programs=("open3d-cpu",), by_device=True)
def extract(field: SurfelField, model: SparseModel, params: ExtractParams, job: Job) -> RawMesh:
    """Fuse the depth that every camera sees of the field into one mesh."""
    from refdgs_pipe.surface.tsdf import Volume
    from refdgs_pipe.training.ground import ground_below
    from refdgs_pipe.training.render import render_surface_map

    model = model.placed(field.poses, field.ball)
    volume = Volume(
        model.ball,
        voxel=params.voxel,
        band=params.band,
        min_alpha=params.min_alpha,
        ground=ground_below(model, field) if params.close else None,
    )
    for camera in job.track(model.cameras, "fusing depth"):
        small = camera.framed(model.ball.center, model.ball.radius).fitted(params.pixels)
        volume.integrate(render_surface_map(field, small, device=job.device, threads=job.threads))
    mesh = volume.extract(min_views=min(params.min_views, volume.views))
    job.measure("views fused", volume.views)
    job.measure("voxel", volume.voxel, "world units")
    job.measure("faces", len(mesh.faces))
    return mesh
