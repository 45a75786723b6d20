"""Tell the surface's material from the light that falls on it."""

from typing import Literal

from pydantic import Field

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.stage import Job, stage


class AppearanceParams(Params):
    """The fit of materials and light to what the field shows."""

    metal: Literal["tell", "none"] = Field(
        "tell", description="tell metal by how its light swings, or make everything non-metal"
    )
    samples: int = Field(
        300_000, ge=1000, le=20_000_000, description="places compared in all views, a count"
    )
    light: int = Field(64, ge=16, le=256, multiple_of=4, description="rows of the light, in texels")
    tolerance: float = Field(0.01, gt=0, le=0.2, description="mesh to field, in ball diameters")


@stage(version=5, programs=("open3d-cpu", "scipy"))
def appearance(
    mesh: Mesh, field: SurfelField, model: SparseModel, params: AppearanceParams, job: Job
) -> Appearance:
    """Fit roughness, metal, colours and light, so that the asset looks as the field does."""
    from refdgs_pipe.texture.fitting import fit, matte
    from refdgs_pipe.texture.sampling import Sampler
    from refdgs_pipe.training.environment import typical_light
    from refdgs_pipe.training.render import render_surface_map

    model = model.placed(field.poses)
    tolerance = params.tolerance * 2 * model.ball.radius
    if not field.shader.reflection:
        return matte(mesh, lift=tolerance / 2)
    cameras = [c for c in model.cameras if c.split == "train"] or list(model.cameras)
    sampler = Sampler(mesh, tolerance=tolerance, per_view=-(-params.samples // len(cameras)))
    for camera in job.track(cameras, "looking at places"):
        small = camera.fitted(sampler.pixels)
        view = render_surface_map(field, small, device=job.device, threads=job.threads)
        sampler.add(view, focal=float(camera.K[0, 0]))
    samples = sampler.samples()
    found = fit(
        mesh,
        samples,
        typical_light(field, samples.roughness, samples.specular, params.light),
        lift=tolerance / 2,
        metal=params.metal == "tell",
        threads=job.threads,
        progress=lambda done, total: job.progress("telling material from light", done, total),
    )
    job.measure("mean light", round(float(found.environment.mean()), 3), "linear, 1 is white")
    job.measure("metal", round(float((found.metallic > 0.5).mean()), 3), "share of the vertices")
    return found
