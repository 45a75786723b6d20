"""Write the product in every format, and check each file before it counts."""

from pydantic import Field

from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class ExportParams(Params):
    """The files that come out."""

    longest: float | None = Field(
        None,
        gt=0,
        le=10_000,
        description="longest side of the object in metres; unset: as the photos' scale tells",
    )
    preview: int = Field(
        480, ge=64, le=4096, description="side of each of the preview's three pictures, in pixels"
    )


@stage(version=1, programs=("usd-core",))
def export(
    textured: TexturedMesh,
    field: SurfelField,
    model: SparseModel,
    params: ExportParams,
    job: Job,
) -> Asset:
    """Write GLB, USDC, USDZ, OBJ, splats and a preview picture."""
    from refdgs_pipe.export import files
    from refdgs_pipe.export.product import metres_per_unit, product
    from refdgs_pipe.export.splats import write_splats

    if params.longest is None and model.metres_per_unit is None:
        job.measure("scale", "unknown: one unit is one metre; set export.longest, in metres")
    scale = metres_per_unit(textured.mesh, known=model.metres_per_unit, longest=params.longest)
    done = product(textured, up=model.up, metres_per_unit=scale)
    for write in job.track(files.writers(preview=params.preview), "writing files"):
        write(job.folder, done)
    write_splats(
        job.folder / "splats.ply",
        means=field.means,
        quats=field.quats,
        scales=field.scales,
        opacities=field.opacities,
        colors=field.diffuse,
    )
    for name in ("asset.glb", "asset.usdz"):
        job.measure(name, round((job.folder / name).stat().st_size / 1e6, 2), "MB")
    job.measure("faces", len(done.faces))
    return Asset.of(job.folder, faces=len(done.faces), texture_size=textured.size)
