"""Tell the surface's material from the light that falls on it."""

from functools import partial

from refdgs_pipe.artifacts.appearance import Appearance
from refdgs_pipe.artifacts.masks import Masks
from refdgs_pipe.artifacts.mesh import Mesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.pipeline.stage import Job, stage
from refdgs_pipe.texture.settings import AppearanceParams


@stage(version=25, programs=("open3d-cpu", "scipy"), by_device=True)
def appearance(
    mesh: Mesh,
    field: SurfelField,
    views: Views,
    masks: Masks,
    model: SparseModel,
    params: AppearanceParams,
    job: Job,
) -> Appearance:
    """Fit roughness, metal, colours and light, so that the asset looks as the field does."""
    from refdgs_pipe.sfm.support import support_plane
    from refdgs_pipe.texture.below import light_below
    from refdgs_pipe.texture.fitting import fit, matte
    from refdgs_pipe.texture.mean_light import MeanLight
    from refdgs_pipe.texture.sampling import Sampler
    from refdgs_pipe.training.environment import typical_light
    from refdgs_pipe.training.render import render_surface_map

    views, model = masks.applied(views, model.names), model.placed(field.poses, field.ball)
    tolerance = params.tolerance * 2 * model.ball.radius
    if not field.shader.reflection:
        return matte(mesh, lift=tolerance / 2)
    cameras = model.training_cameras
    drawn = partial(render_surface_map, field, device=job.device, threads=job.threads, lamp=False)
    plane = support_plane(model.points, model.ball.center, model.ball.radius, model.up)
    at = None if plane is None else plane.at
    below = light_below(drawn, views, model, at, field.lighting, job.track)
    per_view = -(-params.samples // len(cameras))
    sampler = Sampler(mesh, tolerance=tolerance, per_view=per_view, ground=below)
    for camera in job.track(cameras, "looking at places"):
        photo = sampler.photo_of(views, model, camera)
        sampler.look(drawn, photo, camera, field.lighting)
    samples = sampler.samples()
    light = typical_light(field, samples.roughness, samples.specular, params.light)
    mean = MeanLight.of(field.lighting, [c.center for c in cameras], samples.diffuse)
    lift, metal = tolerance / 2, params.metal == "tell"
    told = partial(job.progress, "telling material from light")
    found = fit(
        mesh, samples, light, lift=lift, metal=metal, mean=mean, ground=below, progress=told
    )
    assert found.environment is not None  # a fit always has one
    job.measure("mean light", round(float(found.environment.mean()), 3), "linear, 1 is white")
    job.measure("metal", round(float((found.metallic > 0.5).mean()), 3), "share of the vertices")
    return found
