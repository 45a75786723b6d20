"""Deferred shading in plain torch."""

import torch
from torch import Tensor

from refdgs_pipe.ops.clip import clip, srgb_curve
from refdgs_pipe.ops.plan import Plan
from refdgs_pipe.ops.scene import Pinhole


def normalized(vectors: Tensor, epsilon: float = 1e-16) -> Tensor:
    """Unit vectors along the last axis; zero stays zero."""
    x, y, z = vectors.unbind(-1)
    return vectors * torch.rsqrt(x * x + y * y + z * z + epsilon)[..., None]


def pixel_rays(camera: Pinhole, dtype: torch.dtype = torch.float32) -> Tensor:
    """(H, W, 3) camera-space rays through the pixel centres, with z = 1."""
    x = (torch.arange(camera.width, dtype=dtype) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=dtype) + 0.5 - camera.cy) / camera.fy
    gx, gy = torch.meshgrid(x, y, indexing="xy")
    return torch.stack([gx, gy, torch.ones_like(gx)], -1)


def covered_pixels(alpha: Tensor, least: float, plan: Plan | None = None) -> Tensor:
    """`ops.covered_pixels` without room to spare. A GPU is waited for."""
    return torch.nonzero(alpha.reshape(-1) > least).flatten()


def shading_inputs(
    features: Tensor,
    alpha: Tensor,
    normal: Tensor,
    near: Tensor | None,
    pixels: Tensor,
    camera: Pinhole,
    threads: int = 1,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
    """`ops.shading_inputs`."""

    def at(image: Tensor) -> Tensor:
        return image.reshape(camera.height * camera.width, -1).index_select(0, pixels)

    carried = at(features)[:, :4] / at(alpha)
    n = normalized(at(normal))
    pose = camera.cam_from_world[:3, :3].to(n.dtype)
    rays = pixel_rays(camera, n.dtype)
    rays = at(rays / rays.norm(dim=-1, keepdim=True)) @ pose
    towards = -(n * rays).sum(-1, keepdim=True)
    reflected = normalized(rays + 2 * towards * n)
    cosine = towards[:, 0].clamp(0, 1)
    gathered = None if near is None else at(near)
    return carried[:, :3], carried[:, 3], reflected, cosine, gathered


def srgb_of(linear: Tensor) -> Tensor:
    """The sRGB curve, clipped to [0, 1]; `clip` above."""
    return srgb_curve(clip(linear, 1.0).clamp(min=1e-6))


def composite(
    diffuse: Tensor,
    radiance: Tensor,
    pixels: Tensor,
    object_alpha: Tensor,
    alpha: Tensor,
    backdrop: Tensor,
    behind: Tensor | None = None,
    threads: int = 1,
) -> Tensor:
    """`ops.composite`."""
    height, width = alpha.shape
    flat = diffuse.new_zeros(height * width, 3)
    color = flat.index_copy(0, pixels, srgb_of(diffuse + radiance)).reshape(height, width, 3)
    image = object_alpha[..., None] * color + (1 - alpha)[..., None] * backdrop
    return image if behind is None else image + behind


def depth_normals(depth: Tensor, camera: Pinhole) -> Tensor:
    """(H, W, 3) world normals of a depth map by central differences, facing the camera.

    The border pixel is zero. Source: 2D Gaussian Splatting, section 5.
    """
    points = pixel_rays(camera, depth.dtype) * depth[..., None]
    right = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    normal = normalized(torch.linalg.cross(down, right), 1e-24)
    world = normal @ camera.cam_from_world[:3, :3].to(depth.dtype)
    return torch.nn.functional.pad(world, (0, 0, 1, 1, 1, 1))


def normal_agreement(
    normal: Tensor,
    depth: Tensor,
    alpha: Tensor,
    camera: Pinhole,
    edge: float,
    weight: float,
    whole: bool,
    threads: int = 1,
) -> Tensor:
    """`ops.normal_agreement`."""
    z = depth / alpha.clamp(min=1e-6)
    expected = depth_normals(z, camera)
    z = z.detach()
    bend = torch.maximum(
        (z[2:, 1:-1] + z[:-2, 1:-1] - 2 * z[1:-1, 1:-1]).abs(),
        (z[1:-1, 2:] + z[1:-1, :-2] - 2 * z[1:-1, 1:-1]).abs(),
    )
    smooth = bend * camera.fx < edge * z[1:-1, 1:-1]
    agreement = (normalized(normal) * expected).sum(-1)
    return weight * (((1 - agreement) * alpha.detach())[1:-1, 1:-1] * smooth).mean()


def normal_smoothness(
    normal: Tensor,
    features: Tensor,
    depth: Tensor,
    alpha: Tensor,
    object_alpha: Tensor,
    shaded: float,
    weight: float,
    whole: bool,
    threads: int = 1,
) -> Tensor:
    """`ops.normal_smoothness`."""
    unit = torch.nn.functional.normalize(normal, dim=-1, eps=1e-8)
    object_alpha, alpha = object_alpha.detach()[..., None], alpha.detach()
    diffuse = features[..., :3].detach() / object_alpha.clamp(min=1e-6) * (object_alpha > shaded)
    z, solid = depth.detach() / alpha.clamp(min=1e-6), alpha > 0.9

    def along(axis: int) -> Tensor:
        def first(image: Tensor) -> Tensor:
            return image.narrow(axis, 0, image.shape[axis] - 1)

        def second(image: Tensor) -> Tensor:
            return image.narrow(axis, 1, image.shape[axis] - 1)

        relative = (second(z) - first(z)).abs() / second(z).clamp(min=1e-6)
        edge = 10 * (second(diffuse) - first(diffuse)).abs().sum(-1) + 100 * relative
        steps = (second(unit) - first(unit)).abs().sum(-1)
        return (steps * torch.exp(-edge) * (first(solid) & second(solid))).mean()

    return weight * (along(0) + along(1))
