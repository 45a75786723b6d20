"""From surfels to a picture: splat both sets, shade every covered pixel once, composite."""

from dataclasses import dataclass

import torch
from torch import Tensor

from refdgs_pipe.ops import Maps, Pinhole, ScreenStatistics, Surfels, rasterize
from refdgs_pipe.ops.rasterize import Extra
from refdgs_pipe.training.reflection import Shader, clip, specular

SHADED_ALPHA = 0.05  # thinner pixels show no object
_SH1 = 0.4886025119029199


@dataclass(frozen=True)
class Scene:
    """What is drawn, activated.

    Args:
        geometry: with diffuse (N, 3) and roughness (N,), and features (N, 4) when shared.
        local: with local_features (M, 4); None when there is none (yet).
        background: with background_rgb (B, 3), sRGB, seen from this camera; None when removed.
        shader: None for a matte field.
    """

    geometry: Surfels
    diffuse: Tensor
    roughness: Tensor
    shared_features: Tensor | None
    local: Surfels | None
    local_features: Tensor | None
    background: Surfels | None
    background_rgb: Tensor | None
    shader: Shader | None


@dataclass(frozen=True)
class Picture:
    """One view, (H, W[, C]); linear quantities are not premultiplied and 0 where nothing is.

    Args:
        image: sRGB, composited over the given colour.
        alpha: of the object and, with a background set, everything in front of infinity.
        object_alpha: of the object alone.
        normal: unit, world; depth: camera z.
    """

    image: Tensor
    alpha: Tensor
    object_alpha: Tensor
    normal: Tensor
    depth: Tensor
    diffuse: Tensor
    roughness: Tensor
    specular: Tensor
    distortion: Tensor | None
    geometry_statistics: ScreenStatistics
    local_statistics: ScreenStatistics | None


def srgb_of(linear: Tensor) -> Tensor:
    """The sRGB curve, clipped to [0, 1]."""
    x = clip(linear, 1.0).clamp(min=1e-6)
    return torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def sh_color(sh: Tensor, directions: Tensor) -> Tensor:
    """(B, 3) sRGB of degree-1 spherical harmonics sh (B, 12), coefficient-major, 3DGS signs.

    Args:
        directions: (B, 3) unit, from the camera to the surfel.
    """
    c = sh.reshape(-1, 4, 3)
    x, y, z = directions.unbind(-1)
    basis = torch.stack([-_SH1 * y, _SH1 * z, -_SH1 * x], -1)
    color: Tensor = 0.28209479177387814 * c[:, 0] + (basis[..., None] * c[:, 1:]).sum(1) + 0.5
    return color.clamp(min=0)


def normalized(vectors: Tensor) -> Tensor:
    """Unit vectors along the last axis; zero stays zero."""
    x, y, z = vectors.unbind(-1)
    return vectors * torch.rsqrt(x * x + y * y + z * z + 1e-16)[..., None]


def pixel_rays(camera: Pinhole) -> Tensor:
    """(H, W, 3) unit camera-space rays through the pixel centres."""
    x = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    gx, gy = torch.meshgrid(x, y, indexing="xy")
    rays = torch.stack([gx, gy, torch.ones_like(gx)], -1)
    unit: Tensor = rays / rays.norm(dim=-1, keepdim=True)
    return unit


def _concatenated(scene: Scene) -> tuple[Surfels, Tensor]:
    """Object and background surfels in one list, and what each carries.

    Channels: diffuse 3, roughness 1, [features 4], [inside 1, background rgb 3].
    """
    carried = [scene.diffuse, scene.roughness[:, None]]
    if scene.shared_features is not None:
        carried.append(scene.shared_features)
    if scene.background is None or scene.background_rgb is None:
        return scene.geometry, torch.cat(carried, -1)
    n, width = len(scene.diffuse), sum(c.shape[1] for c in carried)
    inside = torch.cat([*carried, torch.ones(n, 1), torch.zeros(n, 3)], -1)
    outside = torch.cat(
        [torch.zeros(len(scene.background_rgb), width + 1), scene.background_rgb], -1
    )
    g, b = scene.geometry, scene.background
    both = (
        torch.cat(pair)
        for pair in (
            (g.means, b.means),
            (g.quats, b.quats),
            (g.scales, b.scales),
            (g.opacities, b.opacities),
        )
    )
    return Surfels(*both), torch.cat([inside, outside])


def draw(
    scene: Scene,
    camera: Pinhole,
    backdrop: Tensor,
    *,
    extra: Extra = "depth",
    turntable: bool = False,
) -> Picture:
    """Render one view (method: Ref-DGS; colour = diffuse + specular, deferred per pixel).

    Args:
        backdrop: (3,) sRGB colour behind everything.
        turntable: the light is fixed to the camera, not to the world.
    """
    surfels, carried = _concatenated(scene)
    maps = rasterize(surfels, carried, camera, extra=extra, normals=True)
    near, local_statistics = _near_features(scene, camera, maps)
    inside_at = 8 if scene.shared_features is not None else 4
    has_background = scene.background is not None
    object_alpha = maps.features[..., inside_at] if has_background else maps.alpha
    assert maps.normal is not None and maps.depth is not None
    shaded = _shade(scene, camera, maps, near, object_alpha, turntable)
    image = object_alpha[..., None] * shaded.color + (1 - maps.alpha)[..., None] * backdrop
    if has_background:
        image = image + maps.features[..., inside_at + 1 : inside_at + 4]
    return Picture(
        image=image,
        alpha=maps.alpha,
        object_alpha=object_alpha,
        normal=normalized(maps.normal),
        depth=maps.depth / maps.alpha.clamp(min=1e-6),
        diffuse=shaded.diffuse,
        roughness=shaded.roughness[..., 0],
        specular=shaded.specular,
        distortion=maps.distortion,
        geometry_statistics=maps.statistics,
        local_statistics=local_statistics,
    )


@dataclass(frozen=True)
class _Shaded:
    """(H, W, C) of the covered pixels, 0 elsewhere; color is sRGB, the rest linear."""

    color: Tensor
    diffuse: Tensor
    roughness: Tensor
    specular: Tensor


def _shade(
    scene: Scene,
    camera: Pinhole,
    maps: Maps,
    near: Tensor | None,
    alpha: Tensor,
    turntable: bool,
) -> _Shaded:
    """Shade covered pixels, from alpha-normalised maps; near features stay premultiplied."""
    height, width = alpha.shape
    covered = torch.nonzero(alpha.detach().reshape(-1) > SHADED_ALPHA).flatten()

    def at(image: Tensor) -> Tensor:
        return image.reshape(height * width, -1).index_select(0, covered)

    def spread(values: Tensor) -> Tensor:
        flat = values.new_zeros(height * width, values.shape[1]).index_copy(0, covered, values)
        return flat.reshape(height, width, -1)

    carried = at(maps.features[..., :4]) / at(alpha)
    diffuse, roughness = carried[:, :3], carried[:, 3]
    radiance = torch.zeros_like(diffuse)
    if scene.shader is not None:
        assert maps.normal is not None
        normal = normalized(at(maps.normal))
        rays = at(pixel_rays(camera)) @ camera.cam_from_world[:3, :3]
        towards = -(normal * rays).sum(-1, keepdim=True)
        reflected = normalized(rays + 2 * towards * normal)
        if turntable:
            reflected = reflected @ camera.cam_from_world[:3, :3].T
        cosine = towards[:, 0].clamp(0, 1)
        near_pixels = None if near is None else at(near)
        radiance = specular(scene.shader, reflected, roughness, cosine, near_pixels)
    color = srgb_of(diffuse + radiance)
    return _Shaded(*(spread(v) for v in (color, diffuse, roughness[:, None], radiance)))


def _near_features(
    scene: Scene, camera: Pinhole, maps: Maps
) -> tuple[Tensor | None, ScreenStatistics | None]:
    """(H, W, 4) local reflection features, premultiplied: an empty pixel means no near light."""
    if scene.shader is None or scene.shader.local == "none":
        return None, None
    if scene.shared_features is not None:
        return maps.features[..., 4:8], None
    if scene.local is None or scene.local_features is None:
        return None, None
    local = rasterize(scene.local, scene.local_features, camera)
    return local.features, local.statistics
