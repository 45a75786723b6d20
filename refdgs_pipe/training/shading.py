"""From surfels to a picture: splat both sets, shade every covered pixel once, composite."""

from dataclasses import dataclass

import torch
from torch import Tensor

from refdgs_pipe.ops import (
    Maps,
    Pinhole,
    Plan,
    ScreenStatistics,
    Surfels,
    composite,
    covered_pixels,
    damped,
    rasterize,
    shading_inputs,
)
from refdgs_pipe.ops.scene import Extra
from refdgs_pipe.training.moving_light import MovingLight, in_camera
from refdgs_pipe.training.reflection import Shader, specular

SHADED_ALPHA = 0.05  # thinner pixels show no object
_SH1 = 0.4886025119029199


@dataclass(frozen=True)
class Scene:
    """What is drawn, activated.

    Args:
        geometry: with what it carries (N, 4 or 8): diffuse 3, roughness 1, and features 4 if
            `shares`.
        local: with local_features (M, 4); None when there is none (yet).
        background: with background_rgb (B, 3), sRGB, seen from this camera; None when removed.
        shader: None for a matte field.
        light: None where it stands still with the object.
    """

    geometry: Surfels
    carried: Tensor
    shares: bool
    local: Surfels | None
    local_features: Tensor | None
    background: Surfels | None
    background_rgb: Tensor | None
    shader: Shader | None
    light: MovingLight | None = None


@dataclass(frozen=True)
class Picture:
    """One view. What is made of `maps` and of covered pixels costs only when it is asked for.

    Args:
        image: (H, W, 3) sRGB, composited over the given colour.
        maps: of geometry and, with a background set, of everything in front of infinity.
        object_alpha: (H, W) of the object alone.
        pixels: (P,) of `covered_pixels`, which were shaded; there carried diffuse (P, 3) and
            roughness (P,), and radiance (P, 3), linear. Where light moves, diffuse is what the
            surface sends under the mean of it.
        local_statistics: of the local reflection surfels, if there were any.
    """

    image: Tensor
    maps: Maps
    object_alpha: Tensor
    pixels: Tensor
    carried: tuple[Tensor, Tensor]
    radiance: Tensor
    local_statistics: ScreenStatistics | None

    @property
    def normal(self) -> Tensor:
        """(H, W, 3) unit, world; 0 where nothing is."""
        assert self.maps.normal is not None
        return torch.nn.functional.normalize(self.maps.normal, dim=-1, eps=1e-8)

    @property
    def depth(self) -> Tensor:
        """(H, W) camera z."""
        assert self.maps.depth is not None
        return self.maps.depth / self.maps.alpha.clamp(min=1e-6)

    @property
    def diffuse(self) -> Tensor:
        """(H, W, 3) linear, not premultiplied, 0 where nothing was shaded."""
        return self._spread(self.carried[0])

    @property
    def roughness(self) -> Tensor:
        """(H, W), not premultiplied."""
        return self._spread(self.carried[1][:, None])[..., 0]

    @property
    def specular(self) -> Tensor:
        """(H, W, 3) linear radiance, not premultiplied."""
        return self._spread(self.radiance)

    def _spread(self, values: Tensor) -> Tensor:
        height, width = self.object_alpha.shape
        flat = values.new_zeros(height * width + 1, values.shape[1])
        places = torch.where(self.pixels < 0, height * width, self.pixels)  # of no pixel: past all
        return flat.index_copy(0, places, values)[:-1].reshape(height, width, -1)


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


def _concatenated(scene: Scene) -> tuple[Surfels, Tensor]:
    """Object and background surfels in one list, and what each carries.

    Channels: diffuse 3, roughness 1, [features 4], [inside 1, background rgb 3].
    """
    carried = scene.carried
    if scene.background is None or scene.background_rgb is None:
        return scene.geometry, carried
    n, width = carried.shape
    inside = torch.cat([carried, carried.new_ones(n, 1), carried.new_zeros(n, 3)], -1)
    rgb = scene.background_rgb
    outside = torch.cat([rgb.new_zeros(len(rgb), width + 1), rgb], -1)
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
    turn_share: float = 0.0,
    lamp: bool = True,
    plan: Plan | None = None,
) -> Picture:
    """Render one view (method: Ref-DGS; colour = diffuse + specular, deferred per pixel).

    Args:
        backdrop: (3,) sRGB colour behind everything.
        turn_share: see `TrainParams`.
        lamp: whether a flash is mirrored; what it sheds on matte surfaces stays.
        plan: room for a GPU's lists; without it, the GPU is waited for.
    """
    surfels, values = _concatenated(scene)
    maps = rasterize(surfels, values, camera, extra=extra, normals=True, absolute=False, plan=plan)
    object_alpha, behind, composed = maps.alpha, None, maps.share(1).alpha
    whole = composed
    if scene.background is not None:
        inside_at = values.shape[1] - 4
        object_alpha, behind = maps.features[..., inside_at], maps.features[..., inside_at + 1 :]
        composed = object_alpha
    assert maps.normal is not None
    near, local_statistics = _near_features(scene, camera, maps, object_alpha, plan)
    pixels = covered_pixels(object_alpha, SHADED_ALPHA, plan)
    limit = None if plan is None else plan.last()
    diffuse, roughness, reflected, cosine, near = shading_inputs(
        maps.features, object_alpha, maps.normal, near, pixels, camera
    )
    lit = diffuse if scene.light is None else diffuse * _shade(scene.light, maps, pixels, camera)
    if scene.shader is None:
        radiance = diffuse.new_zeros(len(pixels), 3)
    else:
        far, there = _moved(scene.light, camera, reflected, pixels, lamp)
        radiance = specular(scene.shader, far, roughness, cosine, near, limit, from_camera=there)
        if turn_share > 0 and reflected.requires_grad:
            light = radiance.detach(), lit.detach()
            reflected.register_hook(  # type: ignore[no-untyped-call]
                lambda grad: damped(grad, *light, turn_share)
            )
    image = composite(lit, radiance, pixels, composed, whole, backdrop, behind)
    carried = (diffuse, roughness)
    return Picture(image, maps, object_alpha, pixels, carried, radiance, local_statistics)


def _moved(
    light: MovingLight | None, camera: Pinhole, reflected: Tensor, pixels: Tensor, lamp: bool
) -> tuple[Tensor, Tensor | None]:
    """(P, 3) mirrored directions where far light stands still, and in the camera's frame."""
    if light is None:
        return reflected, None
    there = in_camera(reflected, camera) if lamp else None
    turn = light.light_from_world(camera)
    if turn is None:
        return reflected, there
    # what is in rows of no pixel has no meaning, and may not reach the turn's gradient
    real, any_way = (pixels >= 0)[:, None], torch.full_like(reflected, 3**-0.5)
    return torch.where(real, torch.where(real, reflected, any_way) @ turn.T, any_way), there


def _shade(light: MovingLight, maps: Maps, pixels: Tensor, camera: Pinhole) -> Tensor:
    """(P, 3) factor of the diffuse radiance; 1 in rows of no pixel."""
    return torch.where((pixels >= 0)[:, None], light.shade(maps, pixels, camera), 1.0)


def _near_features(
    scene: Scene, camera: Pinhole, maps: Maps, alpha: Tensor, plan: Plan | None
) -> tuple[Tensor | None, ScreenStatistics | None]:
    """(H, W, 4) local reflection features, premultiplied: an empty pixel means no near light.

    Args:
        alpha: (H, W) of the object; pixels that are not shaded are of no interest.
    """
    if scene.shader is None or scene.shader.local == "none":
        return None, None
    if scene.shares:
        return maps.features[..., 4:8], None
    if scene.local is None or scene.local_features is None:
        return None, None
    local = rasterize(
        scene.local,
        scene.local_features,
        camera,
        needed=lambda: alpha.detach() > SHADED_ALPHA,
        absolute=False,
        plan=plan,
    )
    return local.features, local.statistics
