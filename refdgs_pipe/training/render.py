"""Drawing a finished field."""

import numpy as np
import torch
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surface_map import SurfaceMap
from refdgs_pipe.artifacts.surfel_field import SurfelField, SurfelSet
from refdgs_pipe.camera import Camera
from refdgs_pipe.ops import Pinhole, Surfels
from refdgs_pipe.training.moving_light import moving
from refdgs_pipe.training.reflection import Shader
from refdgs_pipe.training.shading import Picture, Scene, draw, sh_color

F32 = NDArray[np.float32]
SURFACE_ALPHA = 0.05


def render_surface_map(
    field: SurfelField,
    camera: Camera,
    *,
    device: str = "cpu",
    threads: int | None = None,
    lamp: bool = True,
) -> SurfaceMap:
    """What the camera sees of the object, over black, without the background surfels' colour.

    Background surfels still hide what is behind them.

    Args:
        lamp: whether the picture of a flash is mirrored.

    Raises:
        DeviceError: this build has no kernels for the device.
    """
    picture = _picture(field, camera, (0.0, 0.0, 0.0), device, threads, lamp)
    alpha = picture.object_alpha
    there = alpha > SURFACE_ALPHA
    return SurfaceMap(
        camera=camera,
        depth=_array(torch.where(there, picture.depth, 0.0)),
        alpha=_array(alpha),
        normal=_array(torch.where(there[..., None], picture.normal, 0.0)),
        diffuse=_array(picture.diffuse),
        specular=_array(picture.specular),
        roughness=_array(picture.roughness),
        color=_array(picture.image.clamp(0, 1)),
    )


def render_image(
    field: SurfelField,
    camera: Camera,
    *,
    backdrop: tuple[float, float, float] = (1.0, 1.0, 1.0),
    device: str = "cpu",
    threads: int | None = None,
) -> F32:
    """(H, W, 3) sRGB picture in [0, 1] over a backdrop colour."""
    return _array(_picture(field, camera, backdrop, device, threads).image.clamp(0, 1))


def _picture(
    field: SurfelField,
    camera: Camera,
    backdrop: tuple[float, float, float],
    device: str,
    threads: int | None,
    lamp: bool = True,
) -> Picture:
    before = torch.get_num_threads()
    torch.set_num_threads(threads or before)
    try:
        with torch.no_grad():
            scene = _scene(field, camera, device)
            color = torch.tensor(backdrop, device=device)
            return draw(scene, Pinhole.of(camera, field.near), color, lamp=lamp)
    finally:
        torch.set_num_threads(before)


def _scene(field: SurfelField, camera: Camera, device: str) -> Scene:
    values = {k: torch.from_numpy(v).to(device) for k, v in field.geometry.values.items()}
    local, background = field.local, field.background
    near = {k: torch.from_numpy(v).to(device) for k, v in local.values.items()}
    rgb = None
    if len(background):
        towards = torch.from_numpy((background.means - camera.center).astype(np.float32))
        towards = towards / towards.norm(dim=-1, keepdim=True)
        rgb = sh_color(torch.from_numpy(background.values["sh"]), towards).to(device)
    return Scene(
        geometry=_surfels(field.geometry, device),
        carried=torch.cat(
            [values[k] for k in ("diffuse", "roughness", "features") if k in values], 1
        ),
        shares="features" in values,
        local=_surfels(local, device) if len(local) else None,
        local_features=near["features"] if len(local) else None,
        background=_surfels(background, device) if len(background) else None,
        background_rgb=rgb,
        shader=shader_of(field, device),
        light=moving(field.lighting, device),
    )


def _surfels(part: SurfelSet, device: str) -> Surfels:
    return Surfels(
        *(
            torch.from_numpy(a).to(device)
            for a in (part.means, part.quats, part.scales, part.opacities)
        )
    )


def shader_of(field: SurfelField, device: str) -> Shader | None:
    """The field's trained shader; None if it is matte."""
    model = field.shader
    if not model.reflection:
        return None
    flash = model.flash is not None
    height = len(model.environment)
    shader = Shader(height, model.local, model.mixing, model.physical, flash=flash).to(device)
    with torch.no_grad():
        tables = [model.environment, *([] if model.flash is None else [model.flash])]
        for own, table in zip(shader.maps(), tables, strict=True):
            own.copy_(torch.from_numpy(table))
        for target, value in zip(
            [*shader.weights, *shader.biases], [*model.weights, *model.biases], strict=True
        ):
            target.copy_(torch.from_numpy(value))
    return shader


def _array(tensor: torch.Tensor) -> F32:
    return np.ascontiguousarray(tensor.cpu().numpy(), np.float32)
