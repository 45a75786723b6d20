"""Surfels and views that a rasteriser can get wrong, in float32 numbers."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from refdgs_pipe.ops import Pinhole, Surfels, rotation_matrices

Made = tuple[Surfels, Tensor]


@dataclass(frozen=True)
class Case:
    """What to draw: surfels with features, an image's size, and which maps."""

    name: str
    make: Callable[[], Made]
    size: tuple[int, int] = (333, 217)
    extra: str = "distortion"
    normals: bool = True


def camera(width: int, height: int) -> Pinhole:
    """A turned camera three units from the origin."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrices(torch.tensor([[0.9, 0.2, -0.3, 0.1]], dtype=torch.float64))[0]
    pose[:3, 3] = torch.tensor([0.1, -0.2, 3.0])
    focal = 1.1 * max(width, height)
    # numbers that float32 holds exactly, so that every device is given the same camera
    pose = pose.float().double()
    return Pinhole(pose, focal, focal, width / 2 + 0.25, height / 2 - 0.5, width, height, 0.2)


def surfels(n: int, channels: int = 6, seed: int = 0) -> Made:
    """Discs of all orientations in a box, sized to cover each other some ten times."""
    g = torch.Generator().manual_seed(seed)
    means = (torch.rand(n, 3, generator=g) - 0.5) * 1.8
    quats = torch.randn(n, 4, generator=g)
    usual = 0.9 / math.sqrt(max(n, 1))
    scales = usual * torch.exp(0.5 * torch.randn(n, 2, generator=g))
    opacities = 0.05 + 0.94 * torch.rand(n, generator=g)
    return Surfels(means, quats, scales, opacities), torch.randn(n, channels, generator=g)


def changed(n: int, change: Callable[[Surfels], None], seed: int = 1) -> Callable[[], Made]:
    """Random surfels of which a half is changed."""

    def make() -> Made:
        made, features = surfels(n, seed=seed)
        parts = Surfels(*(getattr(made, f.name)[: n // 2] for f in fields(made)))
        change(parts)
        return made, features

    return make


def _edge_on(s: Surfels) -> None:
    towards = s.means - torch.tensor([0.0, 0.0, -3.0])
    axis = torch.linalg.cross(towards, torch.randn(s.means.shape))
    axis = axis / axis.norm(dim=-1, keepdim=True)  # normal at a right angle to the ray
    x, y, z = axis.unbind(-1)
    s.quats[:] = torch.stack([1 + z, -y, x, torch.zeros_like(x)], -1)


def _tiny(s: Surfels) -> None:
    s.scales[:] = 1e-5


def _huge(s: Surfels) -> None:
    s.scales[:20] = 2.0
    s.opacities[:20] *= 0.3


def _behind(s: Surfels) -> None:
    s.means[:] -= 50.0


def _off_screen(s: Surfels) -> None:
    s.means[:, 0] += 40.0


def _transparent(s: Surfels) -> None:
    s.opacities[:] = 0.0
    s.opacities[:10] = 1 / 255


def _opaque(s: Surfels) -> None:
    s.opacities[:] = 0.9999


def cases(*, small: bool) -> list[Case]:
    """All of them; `small` ones are for the emulated grid and for a memory checker."""
    n = 120 if small else 4000
    size = (37, 29) if small else (333, 217)
    special = {
        "edge-on": _edge_on,
        "tiny": _tiny,
        "huge": _huge,
        "behind the camera": _behind,
        "off the screen": _off_screen,
        "transparent": _transparent,
        "opaque": _opaque,
    }
    out = [Case("random", lambda: surfels(n), size)]
    out += [Case(name, changed(n, change), size) for name, change in special.items()]
    out += [Case("N = 0", lambda: surfels(0), size), Case("N = 1", lambda: surfels(1), size)]
    sizes = [(1, 1), (17, 31)] if small else [(1, 1), (16, 16), (17, 31), (801, 603)]
    few = min(n, 200)  # so that discs are larger than pixels on small images too
    out += [Case(f"{w} x {h}", lambda: surfels(few, seed=2), (w, h)) for w, h in sizes]
    for channels, extra, normals in ((4, "none", False), (8, "depth", True), (17, "depth", True)):
        name = f"{channels} channels, {extra}"
        out.append(Case(name, lambda c=channels: surfels(n, c), size, extra, normals))  # type: ignore[misc]
    if not small:
        out.append(Case("N = 1,000,000", lambda: surfels(1_000_000, 4, seed=3), (800, 600)))
    return out
