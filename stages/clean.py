"""Turn the fused mesh into one clean surface within a face budget."""

from functools import partial
from typing import Literal

from pydantic import Field

from refdgs_pipe.artifacts.mesh import Mesh, RawMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.camera import Camera
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class CleanParams(Params):
    """Repair and simplification of the mesh."""

    keep: Literal["object", "all"] = Field(
        "all", description="object: without the table or plate that it stands on"
    )
    floater: float = Field(
        0.08, ge=0, le=1, description="smaller loose pieces are removed, in ball diameters"
    )
    hole: float = Field(
        0.15, ge=0, le=10, description="holes with a shorter rim are closed, in ball diameters"
    )
    smoothing: int = Field(5, ge=0, le=200, description="smoothing steps (Taubin), a count")
    outlines: int = Field(
        3, ge=0, le=20, description="times that the mesh is fitted to the views' outlines, a count"
    )
    faces: int = Field(
        50_000, ge=100, le=5_000_000, description="the most triangles the mesh may have, a count"
    )


@stage(version=3, programs=("pymeshlab", "open3d-cpu"))
def clean(
    raw: RawMesh, field: SurfelField, model: SparseModel, params: CleanParams, job: Job
) -> Mesh:
    """Remove floaters, repair, close small holes, smooth, simplify, and fit to the outlines."""
    from refdgs_pipe.surface import cleanup
    from refdgs_pipe.surface.silhouettes import fitted
    from refdgs_pipe.surface.support import above_support, find_support
    from refdgs_pipe.training.render import render_surface_map

    diameter = 2 * model.ball.radius
    job.progress("cleaning", 0, None)
    support = find_support(raw, model.up, diameter) if params.keep == "object" else None
    if support is not None:
        job.measure("support's share of the area", round(support.share, 4))
        job.measure("cut above the support", round(support.margin, 5), "world units")
    elif params.keep == "object":
        job.warn(
            "clean.keep=object: found no level surface that something stands on, so that "
            "everything is kept. Photograph more of the table, check the up axis (sfm.up), "
            "mask the photos, or cut the mesh and adopt it"
        )
    done = cleanup.clean(
        above_support(raw, support) if support else raw,
        floater=params.floater * diameter,
        hole=params.hole * diameter,
        smoothing=params.smoothing,
        faces=params.faces,
        stop=job.stop,
    )
    removed, mesh = done.removed, done.mesh
    job.measure("faces", len(mesh.faces))
    job.measure("floaters removed", removed.pieces)
    job.measure("floaters' share of the area", round(removed.area_share, 4))
    job.measure("open rims", len(done.rims))
    job.measure("open area", round(sum(r.area for r in done.rims), 4), "square world units")
    if removed.area_share > 0.2:
        job.warn(f"{removed.area_share:.0%} of the fused surface was loose pieces and is removed")
    render = partial(render_surface_map, field, device=job.device, threads=job.threads)

    def draw(camera: Camera) -> SurfaceMap:
        view = render(camera)
        return support.hidden(view) if support else view

    return fitted(mesh, model, draw, rounds=params.outlines, track=job.track)
