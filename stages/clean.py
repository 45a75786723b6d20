"""Turn the fused mesh into one clean surface within a face budget."""

from dataclasses import replace
from functools import partial
from typing import Literal

from pydantic import Field

from refdgs_pipe.artifacts.mesh import Mesh, RawMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class CleanParams(Params):
    """Repair and simplification of the mesh."""

    keep: Literal["object", "all"] = Field("all", description="object: no table or plate below it")
    floater: float = Field(
        0.08, ge=0, le=1, description="smaller loose pieces are removed, in ball diameters"
    )
    hole: float = Field(0.15, ge=0, le=10, description="shorter rims are closed, in ball diameters")
    smoothing: int = Field(5, ge=0, le=200, description="smoothing steps (Taubin), a count")
    outlines: int = Field(3, ge=0, le=20, description="fits of the mesh to its views, a count")
    flatten: bool = Field(True, description="make flat what outlines show to be flat")
    faces: int = Field(50_000, ge=100, le=5_000_000, description="the most triangles, a count")


@stage(version=6, programs=("pymeshlab", "open3d-cpu"))
def clean(
    raw: RawMesh, field: SurfelField, model: SparseModel, params: CleanParams, job: Job
) -> Mesh:
    """Remove floaters, repair, close small holes, smooth, simplify, and fit to the views."""
    from refdgs_pipe.surface import cleanup, registration, support
    from refdgs_pipe.training import ground, render

    model = model.placed(field.poses, field.ball)
    diameter = 2 * model.ball.radius
    job.progress("cleaning", 0, None)
    under = support.find_support(raw, model.up, diameter) if params.keep == "object" else None
    if params.keep == "object" and under is None and not ground.left_to_background(model, field):
        job.warn(support.NONE_FOUND)
    sizes = {"floater": params.floater * diameter, "hole": params.hole * diameter}
    done = cleanup.clean(
        support.above_support(raw, under) if under else raw,
        **sizes,
        smoothing=params.smoothing,
        faces=params.faces - (params.faces // 16 if params.outlines else 0),  # walls come yet
        stop=job.stop,
    )
    if (lost := done.removed.area_share) > 0.2:
        job.warn(f"{lost:.0%} of the fused surface was loose pieces and is removed")
    draw = partial(render.render_surface_map, field, device=job.device, threads=job.threads)
    fit = partial(registration.fitted, rounds=params.outlines, faces=params.faces)
    mesh, flats = fit(done.mesh, model, draw, flatten=params.flatten, track=job.track)
    for name, value, unit in [*replace(done, mesh=mesh).figures(), *support.figures(under)]:
        job.measure(name, value, unit)
    job.measure("parts made flat", flats)
    return mesh
