"""Paint the mesh from the field: colour, roughness, metal and normals."""

from pydantic import Field, field_validator

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.mesh import UvMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class BakeParams(Params):
    """The textures."""

    size: int = Field(
        2048, ge=64, le=8192, description="side of the textures, in texels; a power of two"
    )
    tolerance: float = Field(
        0.01,
        gt=0,
        le=0.2,
        description="how far mesh and field may lie apart, in diameters of the object ball",
    )

    @field_validator("size")
    @classmethod
    def _is_power_of_two(cls, size: int) -> int:
        if size & (size - 1):
            raise ValueError(f"{size} is not a power of two: 1024, 2048 and 4096 are")
        return size


@stage(version=4, programs=("open3d-cpu",))
def bake(
    mesh: UvMesh,
    looks: Appearance,
    field: SurfelField,
    model: SparseModel,
    params: BakeParams,
    job: Job,
) -> TexturedMesh:
    """Gather what all cameras see of every texel, free of reflections."""
    from refdgs_pipe.texture.material import Painter
    from refdgs_pipe.training.render import render_surface_map

    painter = Painter(mesh, params.size, tolerance=params.tolerance * 2 * model.ball.radius)
    for camera in job.track(model.cameras, "gathering texels"):
        painter.add(render_surface_map(field, camera, device=job.device, threads=job.threads))
    textured = painter.paint(looks)
    job.measure("texture size", params.size, "px")
    job.measure("texels seen", round(painter.seen_share, 4))
    if painter.seen_share < 0.9:
        job.warn(
            f"{1 - painter.seen_share:.0%} of the surface was seen by no camera; its colours "
            "are filled in from beside it"
        )
    return textured
