"""Mesh a field in training, for surfels to start anew on."""

from functools import partial

from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.artifacts.shape import Shape
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.errors import MeshError
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.surface.settings import ShapeParams


@stage(version=4, programs=("pymeshlab", "open3d-cpu"), by_device=True)
def shape(checkpoint: Checkpoint, model: SparseModel, params: ShapeParams, job: Job) -> Shape:
    """Fuse what training cameras see of the field, clean it and fit it to its views."""
    if checkpoint.is_last:
        return Shape(None)
    from refdgs_pipe.surface.own import own_surface
    from refdgs_pipe.training.ground import ground_below
    from refdgs_pipe.training.render import render_surface_map

    field = checkpoint.field
    placed = model.placed(field.poses, field.ball)
    draw = partial(render_surface_map, field, device=job.device, threads=job.threads)
    ground = ground_below(placed, field)
    try:
        mesh = own_surface(placed, draw, ground, params, job.track, job.stop)
    except MeshError as error:
        return Shape(None, str(error))
    job.measure("faces", len(mesh.faces))
    return Shape(mesh)
