"""Write the product in every format, and check each file before it counts."""

from functools import partial

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.textured_mesh import TexturedMesh
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.export.settings import ExportParams
from refdgs_pipe.pipeline.stage import Job, stage


@stage(version=5, programs=("usd-core", "pymeshlab"))
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
    from refdgs_pipe.export.targets.delivering import deliver
    from refdgs_pipe.export.targets.difference import photo_loss
    from refdgs_pipe.export.targets.order import Order
    from refdgs_pipe.texture.levels import level, levels

    scale, told = scale_of(textured.mesh, known=model.metres_per_unit, longest=params.longest)
    size = told_size(textured.mesh, scale, told)
    job.measure("size", size)
    about = about_asset(params.recipe, (v.source or v.name for v in views.items), scale, told)
    turned = partial(product, up=model.up, metres_per_unit=scale, about=about)
    done, frame = turned(textured), AssetFrame.of(model.up, scale)
    light = latlong_light(frame, looks.environment, params.environment)
    placed = model.placed(field.poses)
    around = files.Surroundings(frame, light, placed.cameras, field.geometry)
    for write in job.track(files.writers(around, preview=params.preview), "writing files"):
        write(job.folder, done)
    for number, lod in enumerate(levels(textured, params.lods, stop=job.stop), 1):
        files.glb(job.folder, turned(lod.textured), name=f"asset_lod{number}.glb")
        job.measure(f"level {number}", len(lod.textured.mesh.faces), lod.told(scale))
    coarser = partial(level, textured, stop=job.stop)
    loss = photo_loss(textured, looks, frame, views, placed)
    order = Order(job.folder, textured, around, turned, coarser, loss, size, told != "unknown")
    targets = []
    for target in job.track(params.targets, "writing targets"):
        targets.append(deliver(target, order, job.warn))
        job.measure(f"target {target}", targets[-1].summary)
    for name in ("asset.glb", "asset.usdz"):
        job.measure(name, round((job.folder / name).stat().st_size / 1e6, 2), "MB")
    job.measure("faces", len(done.faces))
    files_of = partial(Asset.of, faces=len(done.faces), texture_size=textured.size)
    return files_of(job.folder, targets=tuple(targets))
