"""Write the product in every format, and check each file before it counts."""

from functools import partial

from pydantic import Field, PositiveInt

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

    longest: float | None = Field(None, gt=0, le=10_000, description="longest side, in metres")
    lods: tuple[PositiveInt, ...] = Field((), description="triangles of coarser GLBs, counts")
    preview: int = Field(480, ge=64, le=4096, description="side of each preview picture, in pixels")
    environment: int = Field(512, ge=16, le=4096, description="rows of environment.hdr, in pixels")
    recipe: str = Field("", max_length=200, description="name to note; empty: the recipe's own")


@stage(version=4, programs=("usd-core", "pymeshlab"))
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
    from refdgs_pipe.export import files
    from refdgs_pipe.export.about import about_asset
    from refdgs_pipe.export.frame import AssetFrame, latlong_light
    from refdgs_pipe.export.product import product, scale_of, told_size
    from refdgs_pipe.texture.levels import levels

    scale, told = scale_of(textured.mesh, known=model.metres_per_unit, longest=params.longest)
    job.measure("size", told_size(textured.mesh, scale, told))
    about = about_asset(params.recipe, (v.source or v.name for v in views.items), scale, told)
    turned = partial(product, up=model.up, metres_per_unit=scale, about=about)
    done, frame = turned(textured), AssetFrame.of(model.up, scale)
    light = latlong_light(frame, looks.environment, params.environment)
    cameras = model.placed(field.poses).cameras
    around = files.Surroundings(frame, light, cameras, field.geometry)
    for write in job.track(files.writers(around, preview=params.preview), "writing files"):
        write(job.folder, done)
    for number, level in enumerate(levels(textured, params.lods, stop=job.stop), 1):
        files.glb(job.folder, turned(level.textured), name=f"asset_lod{number}.glb")
        job.measure(f"level {number}", len(level.textured.mesh.faces), level.told(scale))
    for name in ("asset.glb", "asset.usdz"):
        job.measure(name, round((job.folder / name).stat().st_size / 1e6, 2), "MB")
    job.measure("faces", len(done.faces))
    return Asset.of(job.folder, faces=len(done.faces), texture_size=textured.size)
