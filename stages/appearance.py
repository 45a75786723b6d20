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


@stage(version=8, programs=("open3d-cpu", "scipy"), by_device=True)
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
    from refdgs_pipe.artifacts.photos import load_photo
    from refdgs_pipe.color import linear_from_srgb
    from refdgs_pipe.texture.fitting import fit, matte
    from refdgs_pipe.texture.mean_light import MeanLight
    from refdgs_pipe.texture.sampling import Sampler, Shone
    from refdgs_pipe.training.environment import typical_light
    from refdgs_pipe.training.render import render_surface_map

    views, model = masks.applied(views, model.names), model.placed(field.poses, field.ball)
    tolerance = params.tolerance * 2 * model.ball.radius
    if not field.shader.reflection:
        return matte(mesh, lift=tolerance / 2)
    cameras = model.training_cameras
    drawn = partial(render_surface_map, field, device=job.device, threads=job.threads, lamp=False)
    sampler = Sampler(mesh, tolerance=tolerance, per_view=-(-params.samples // len(cameras)))
    for camera in job.track(cameras, "looking at places"):
        photo = load_photo(views, model, camera, scale=sampler.scale(camera))
        view = drawn(photo.camera)
        turn, lamp = field.lighting.light_from_world(camera.center), None
        if (place := field.lighting.lamp_of(camera)) is not None:
            lamp = Shone(place, linear_from_srgb(drawn(photo.camera, lamp=True).color))
        focal = float(camera.K[0, 0])
        sampler.add(view, photo=photo.alone(), focal=focal, turn=turn, lamp=lamp)
    samples = sampler.samples()
    light = typical_light(field, samples.roughness, samples.specular, params.light)
    mean = MeanLight.of(field.lighting, [c.center for c in cameras], samples.diffuse)
    lift, metal = tolerance / 2, params.metal == "tell"
    told = partial(job.progress, "telling material from light")
    found = fit(mesh, samples, light, lift=lift, metal=metal, mean=mean, progress=told)
    assert found.environment is not None  # a fit always has one
    job.measure("mean light", round(float(found.environment.mean()), 3), "linear, 1 is white")
    job.measure("metal", round(float((found.metallic > 0.5).mean()), 3), "share of the vertices")
    return found
