"""Turn the fused mesh into one clean surface within a face budget."""

from refdgs_pipe.artifacts.mesh import CleanMesh, RawMesh, TriangleMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.surface.settings import CleanParams


@stage(version=9, programs=("pymeshlab", "open3d-cpu"))
def clean(
    raw: RawMesh, field: SurfelField, model: SparseModel, params: CleanParams, job: Job
) -> CleanMesh:
    """Remove floaters, repair, close small holes, smooth and simplify."""
    from refdgs_pipe.surface import cleanup, support
    from refdgs_pipe.surface.gaps import without_base
    from refdgs_pipe.training import ground

    model = model.placed(field.poses, field.ball)
    diameter = 2 * model.ball.radius
    job.progress("cleaning", 0, None)
    under = support.find_support(raw, model.up, diameter) if params.keep == "object" else None
    if params.keep == "object" and under is None and not ground.left_to_background(model, field):
        job.warn(support.NONE_FOUND)
    standing: TriangleMesh = support.above_support(raw, under) if under else raw
    level = ground.ground_below(model, field)
    if params.base == "closed" and level is None:
        job.warn(support.NO_GROUND)
    if params.base == "open" and level is not None:
        standing = without_base(standing, level, diameter)
    done = cleanup.clean(
        standing,
        floater=params.floater * diameter,
        hole=params.hole * diameter,
        smoothing=params.smoothing,
        faces=params.faces_before_walls,
        base=level if params.base == "closed" else None,
        stop=job.stop,
    )
    if (lost := done.removed.area_share) > 0.2:
        job.warn(f"{lost:.0%} of the fused surface was loose pieces and is removed")
    for name, value, unit in [*done.figures(), *support.figures(under)]:
        job.measure(name, value, unit)
    return CleanMesh(done.mesh.vertices, done.mesh.faces, params.faces)
