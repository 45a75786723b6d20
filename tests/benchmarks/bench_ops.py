"""Fused operations against stock torch, one thread: core-milliseconds, forward and backward.

pytest -m benchmark -s tests/benchmarks/bench_ops.py
"""

import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial

import pytest
import torch
from torch import Tensor

from refdgs_pipe import ops
from refdgs_pipe.ops import Pinhole, composited, image_loss, mask_entropy, mlp, sph_mip
from refdgs_pipe.ops.definition import sph_mip as definition
from refdgs_pipe.ops.native import keep_freed_memory
from refdgs_pipe.ops.registry import using

pytestmark = pytest.mark.benchmark
ROUNDS = 7


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    keep_freed_memory()  # as training does, for both sides
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def core_ms(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """The median of process CPU time, which other people's load hardly changes."""
    work()
    times = []
    for _ in range(rounds):
        start = time.process_time()
        work()
        times.append((time.process_time() - start) * 1e3)
    return statistics.median(times)


def compare(name: str, ours: Callable[[], object], stock: Callable[[], object]) -> None:
    fast, slow = core_ms(ours), core_ms(stock)
    print(f"\n{name:60s} ours {fast:8.2f}   torch {slow:8.2f}   {slow / fast:6.1f}x", end="")


def with_backward(loss_of: Callable[..., Tensor], *leaves: Tensor) -> Callable[[], object]:
    def work() -> None:
        for leaf in leaves:
            leaf.grad = None
        loss_of(*leaves).backward()

    return work


def by_definition(loss_of: Callable[..., Tensor], *leaves: Tensor) -> Callable[[], object]:
    """The same in plain torch."""
    work = with_backward(loss_of, *leaves)

    def run() -> None:
        with using("definition"):
            work()

    return run


@pytest.mark.parametrize("size", [400, 800])
def test_image_loss(size: int) -> None:
    g = torch.Generator().manual_seed(0)
    planes = torch.rand(3, size, size, generator=g).requires_grad_()
    target = torch.rand(size, size, 3, generator=g)
    compare(
        f"L1 + SSIM {size}x{size}x3",
        with_backward(lambda p: image_loss(p.permute(1, 2, 0), target), planes),
        by_definition(lambda p: image_loss(p.permute(1, 2, 0), target), planes),
    )


@pytest.mark.parametrize("size", [400, 800])
def test_photo(size: int) -> None:
    """The target over a backdrop, and the mask's entropy of it, half of it soft."""
    g = torch.Generator().manual_seed(0)
    rgb = torch.randint(0, 256, (3, size, size), generator=g, dtype=torch.uint8)
    mask = torch.randint(0, 256, (size, size), generator=g, dtype=torch.uint8)
    backdrop, alpha = torch.rand(3, generator=g), torch.rand(size, size, generator=g)
    alpha.requires_grad_()

    def loss_of(a: Tensor) -> Tensor:
        return mask_entropy(a, mask) + composited(rgb, mask, backdrop)[0, 0, 0]

    compare(
        f"target and mask's entropy {size}x{size}",
        with_backward(loss_of, alpha),
        by_definition(loss_of, alpha),
    )


def sphere(count: int) -> Tensor:
    """Directions in the order in which the rows of a ball's image reflect them."""
    side = math.isqrt(count)
    y, x = torch.meshgrid(*[torch.linspace(-0.99, 0.99, side)] * 2, indexing="ij")
    x = x * (1 - y * y).sqrt()
    normal = torch.stack([x, y, (1 - x * x - y * y).clamp(min=0).sqrt()], -1).reshape(-1, 3)
    view = torch.tensor([0.0, 0.6, 0.8])
    return 2 * (normal @ view)[:, None] * normal - view


@pytest.mark.parametrize("size", [(256, 512), (512, 1024)])
@pytest.mark.parametrize("order", ["image", "random"])
@pytest.mark.parametrize("count", [40_000, 300_000])
def test_sph_mip(size: tuple[int, int], order: str, count: int) -> None:
    g = torch.Generator().manual_seed(0)
    base = torch.randn(*size, 4, generator=g).requires_grad_()
    directions = sphere(count)
    count = len(directions)
    if order == "random":
        directions = directions[torch.randperm(count, generator=g)]
    directions = directions.requires_grad_()
    roughness = (0.05 + 0.5 * torch.rand(count, generator=g)).requires_grad_()
    pull = torch.randn(count, 4, generator=g)
    leaves = (base, directions, roughness)
    compare(
        f"Sph-Mip {count} {order} of {size[0]}x{size[1]}",
        with_backward(lambda *t: (sph_mip(*t) * pull).sum(), *leaves),
        with_backward(lambda *t: (grid_sample_mips(*t) * pull).sum(), *leaves),
    )


def grid_sample_mips(base: Tensor, directions: Tensor, roughness: Tensor) -> Tensor:
    """The fastest stock way: every level by grid_sample, padded for the seam; poles clamped."""
    u, v = definition.polar(directions)
    mips = definition.mips(base)
    level = (len(mips) * roughness).clamp(0, len(mips) - 1)
    features = base.new_zeros(len(u), 4)
    fine = level.detach().long().clamp(max=len(mips) - 2)
    for index, mip in enumerate(mips):
        share = (1 - (level - index).abs()).clamp(min=0)
        chosen = ((fine == index) | (fine == index - 1)).nonzero()[:, 0]
        padded = torch.cat([mip[:, -1:], mip, mip[:, :1]], 1).permute(2, 0, 1)[None]
        width = mip.shape[1]
        x = (u[chosen] * width + 1) / (width + 2) * 2 - 1
        grid = torch.stack([x, v[chosen] * 2 - 1], -1)[None, None]
        values = torch.nn.functional.grid_sample(
            padded, grid, padding_mode="border", align_corners=False
        )
        features = features.index_add(0, chosen, share[chosen, None] * values[0, :, 0].T)
    return features


@pytest.mark.parametrize("count", [40_000, 100_000])
def test_mlp(count: int) -> None:
    g = torch.Generator().manual_seed(0)
    widths = [10, 64, 64, 64, 3]
    x = torch.randn(count, 10, generator=g).requires_grad_()
    layers = [torch.nn.Linear(a, b) for a, b in itertools.pairwise(widths)]
    weights, biases = [layer.weight for layer in layers], [layer.bias for layer in layers]
    pull = torch.randn(count, 3, generator=g)

    def loss_of(run: Callable[..., Tensor]) -> Callable[..., Tensor]:
        return lambda *t: (run(t[0], t[1:5], t[5:], exp_cap=5.0) * pull).sum()

    leaves = (x, *weights, *biases)
    for name, run in (("float", mlp), ("bfloat16 where the CPU can", partial(mlp, half=True))):
        compare(
            f"MLP 10-64-64-64-3, {count} points, {name}",
            with_backward(loss_of(run), *leaves),
            by_definition(loss_of(mlp), *leaves),
        )


@pytest.mark.parametrize("size", [400, 800])
def test_shading(size: int) -> None:
    """Gather, composite and normal agreement: everything around the lookup and the network."""
    g = torch.Generator().manual_seed(0)
    camera = Pinhole(torch.eye(4), 1.2 * size, 1.2 * size, size / 2, size / 2, size, size)
    side = torch.linspace(-1, 1, size)
    disc = (side[:, None] ** 2 + side[None] ** 2) < 0.64  # half of the image
    maps = [torch.rand(c, size, size, generator=g) * disc for c in (4, 3, 4)]
    images = [m.permute(1, 2, 0) for m in maps]  # plane by plane, as the rasteriser leaves them
    alpha = disc * 0.999
    depth = 3 * alpha + 0.1 * torch.rand(size, size, generator=g) * disc
    pixels = disc.flatten().nonzero().flatten()
    backdrop = torch.rand(3, generator=g)

    def loss_of(
        features: Tensor, normal: Tensor, near: Tensor, alpha: Tensor, depth: Tensor
    ) -> Tensor:
        diffuse, _, reflected, cosine, found = ops.shading_inputs(
            features, alpha, normal, near, pixels, camera
        )
        assert found is not None
        radiance = (reflected + found[:, :3]) * cosine[:, None]
        image = ops.composite(diffuse, radiance, pixels, alpha, alpha, backdrop, None)
        return image.mean() + ops.normal_agreement(normal, depth, alpha, camera)

    leaves = tuple(t.requires_grad_() for t in (*images, alpha, depth))
    compare(
        f"shading around the network {size}x{size}",
        with_backward(loss_of, *leaves),
        by_definition(loss_of, *leaves),
    )
