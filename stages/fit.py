"""Fit the clean mesh to what the cameras see of the field."""

from functools import partial

from refdgs_pipe.artifacts.mesh import CleanMesh, Mesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.surface.settings import FitParams


@stage(version=7, programs=("open3d-cpu",), by_device=True)
def fit(
    cleaned: CleanMesh, field: SurfelField, model: SparseModel, params: FitParams, job: Job
) -> Mesh:
    """Move the mesh to the outlines and colours that the views show, and make flat parts flat."""
    from refdgs_pipe.surface.registration import fitted
    from refdgs_pipe.training.ground import ground_below
    from refdgs_pipe.training.render import render_surface_map

    model = model.placed(field.poses, field.ball)
    mesh, flats = fitted(
        cleaned,
        model,
        partial(render_surface_map, field, device=job.device, threads=job.threads),
        rounds=params.outlines,
        faces=cleaned.budget,
        flatten=params.flatten,
        ground=ground_below(model, field),
        track=job.track,
    )
    job.measure("faces", len(mesh.faces))
    job.measure("parts made flat", flats)
    return mesh
