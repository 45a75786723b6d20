"""What a picture is asked to agree with."""

import torch
from torch import Tensor

from refdgs_pipe.ops import Pinhole


def depth_normals(depth: Tensor, camera: Pinhole) -> Tensor:
    """(H, W, 3) world normals of a depth map by central differences, facing the camera.

    The border pixel is zero. Source: 2D Gaussian Splatting, section 5.
    """
    height, width = depth.shape
    x = ((torch.arange(width) + 0.5 - camera.cx) / camera.fx)[None, :]
    y = ((torch.arange(height) + 0.5 - camera.cy) / camera.fy)[:, None]
    points = torch.stack([x * depth, y * depth, depth])
    right = points[:, 1:-1, 2:] - points[:, 1:-1, :-2]
    down = points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    (ax, ay, az), (bx, by, bz) = down, right
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    normal = torch.stack([x, y, z]) * torch.rsqrt(x * x + y * y + z * z + 1e-24)
    world = camera.cam_from_world[:3, :3].T @ normal.flatten(1)
    padded = torch.nn.functional.pad(world.reshape(normal.shape), (1, 1, 1, 1))
    return padded.permute(1, 2, 0)


def normal_consistency(normal: Tensor, depth: Tensor, alpha: Tensor, camera: Pinhole) -> Tensor:
    """Mean over all pixels of alpha (1 - n . n_depth); gradients reach both normals."""
    agreement = (normal * depth_normals(depth, camera)).sum(-1)
    return ((1 - agreement) * alpha.detach())[1:-1, 1:-1].mean()


def mask_entropy(alpha: Tensor, mask: Tensor) -> Tensor:
    """Mean binary cross-entropy of the alpha map against a soft mask."""
    a = alpha.clamp(1e-4, 1 - 1e-4)
    return -(mask * torch.log(a) + (1 - mask) * torch.log(1 - a)).mean()


def normal_smoothness(normal: Tensor, diffuse: Tensor, depth: Tensor, alpha: Tensor) -> Tensor:
    """Mean |gradient of n|, damped at diffuse and depth edges but not at reflection edges."""

    def along(axis: int) -> Tensor:
        def step(image: Tensor) -> Tensor:
            n = image.shape[axis]
            return image.narrow(axis, 1, n - 1) - image.narrow(axis, 0, n - 1)

        solid = alpha.detach() > 0.9
        n = solid.shape[axis]
        both = solid.narrow(axis, 1, n - 1) & solid.narrow(axis, 0, n - 1)
        relative = step(depth.detach()).abs() / depth.detach().narrow(axis, 1, n - 1).clamp(
            min=1e-6
        )
        edge = 10 * step(diffuse.detach()).abs().sum(-1) + 100 * relative
        return (step(normal).abs().sum(-1) * torch.exp(-edge) * both).mean()

    return along(0) + along(1)
