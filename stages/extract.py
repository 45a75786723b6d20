"""Fuse the field's depth into one mesh."""

from pydantic import Field

from refdgs_pipe.artifacts.mesh import RawMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class ExtractParams(Params):
    """Fusion of depth maps on a voxel grid."""

    voxel: float = Field(
        0.004, ge=0.0008, le=0.05, description="edge of a voxel, in diameters of the object ball"
    )
    band: float = Field(
        4.0, ge=2, le=16, description="half-width of the signed-distance band, in voxels"
    )
    min_alpha: float = Field(
        0.5, ge=0, le=1, description="pixels that the surface covers less are ignored (share)"
    )
    min_views: int = Field(
        2, ge=1, le=50, description="views that must see a place for it to become surface (count)"
    )
    close: bool = Field(
        True, description="close gaps that no view sees, on the ground that the object stands on"
    )
    pixels: int = Field(
        960, ge=64, le=8192, description="longest side of the depth maps, in pixels"
    )


@stage(version=2, programs=("open3d-cpu",))
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
        small = camera.fitted(params.pixels)
        volume.integrate(render_surface_map(field, small, device=job.device, threads=job.threads))
    mesh = volume.extract(min_views=min(params.min_views, volume.views))
    job.measure("views fused", volume.views)
    job.measure("voxel", volume.voxel, "world units")
    job.measure("faces", len(mesh.faces))
    return mesh
