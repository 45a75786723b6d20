"""Write the product in every format, and check each file before it counts."""

from pydantic import Field

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
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
    preview: int = Field(480, ge=64, le=4096, description="side of each preview picture, in pixels")
    environment: int = Field(512, ge=16, le=4096, description="rows of environment.hdr, in pixels")
    recipe: str = Field("", max_length=200, description="name to note; empty: the recipe's own")


@stage(version=3, programs=("usd-core",))
def export(
    textured: TexturedMesh,
    looks: Appearance,
    field: SurfelField,
    model: SparseModel,
    views: Views,
    params: ExportParams,
    job: Job,
) -> Asset:
    """Write GLB, USDC, USDZ, OBJ, splats, the surroundings and a preview picture."""
    from refdgs_pipe.export.about import about_asset
    from refdgs_pipe.export.files import Surroundings, writers
    from refdgs_pipe.export.frame import AssetFrame, latlong_light
    from refdgs_pipe.export.product import product, scale_of

    scale, told = scale_of(textured.mesh, known=model.metres_per_unit, longest=params.longest)
    if told == "unknown":
        job.measure("scale", "unknown: one unit is one metre; set export.longest, in metres")
    about = about_asset(params.recipe, (v.source or v.name for v in views.items), scale, told)
    done = product(textured, up=model.up, metres_per_unit=scale, about=about)
    frame = AssetFrame.of(model.up, scale)
    light = latlong_light(frame, looks.environment, params.environment)
    around = Surroundings(frame, light, model.cameras, field.geometry)
    for write in job.track(writers(around, preview=params.preview), "writing files"):
        write(job.folder, done)
    for name in ("asset.glb", "asset.usdz"):
        job.measure(name, round((job.folder / name).stat().st_size / 1e6, 2), "MB")
    job.measure("faces", len(done.faces))
    return Asset.of(job.folder, faces=len(done.faces), texture_size=textured.size)
