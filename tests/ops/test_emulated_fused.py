"""The CUDA kernels of the fused operations on the emulated grid, against the CPU's in float64."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from emulation import ORDERS, emulated
from ops import test_image_loss as losses
from ops import test_mlp as networks
from ops import test_photo as photos
from ops import test_shade as shades
from ops import test_sph_mip as mips
from refdgs_pipe.ops.cuda_adam import adam_step, rates_of
from torch import Tensor

from refdgs_pipe import ops
from refdgs_pipe.ops import cuda_fused


def alike(
    run: Callable[[], list[Tensor]], order: int = 0, *, exact: float = 1e-9
) -> tuple[list[Tensor], list[Tensor]]:
    wanted = run()
    with emulated(order):
        found = run()
    for a, b in zip(found, wanted, strict=True):
        scale = float(b.abs().max()) if b.numel() else 1.0
        torch.testing.assert_close(a, b, rtol=exact, atol=exact * scale)
    return found, wanted


def loss_and_gradient(size: tuple[int, int], weighted: bool) -> list[Tensor]:
    image, target, weight = losses.pair(*size)
    leaf = image.clone().requires_grad_()
    loss, error = ops.image_loss_and_error(
        leaf, target, weight=weight if weighted else None, ssim_share=0.3
    )
    assert not error.requires_grad
    (2.5 * loss).backward()
    return [loss.detach(), error, leaf.grad, ops.ssim_map(image, target)]


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (33, 5), (37, 29)])
@pytest.mark.parametrize("weighted", [False, True])
def test_image_loss(size: tuple[int, int], weighted: bool) -> None:
    alike(lambda: loss_and_gradient(size, weighted))


def test_image_loss_reads_any_strides_and_nothing_counts_for_nothing() -> None:
    image, target, _ = losses.pair(20, 21)
    planes = image.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    none = torch.zeros(20, 21, dtype=torch.float64)

    def run() -> list[Tensor]:
        leaf = planes.clone().requires_grad_()
        loss = ops.image_loss(leaf[:17, 2:], target[:17, 2:])
        loss.backward()
        weightless = ops.image_loss_and_error(image, target, weight=none)
        return [loss.detach(), leaf.grad, *weightless, torch.tensor(ops.ssim(image, target))]

    alike(run)


@pytest.mark.parametrize("size", [(1, 1), (photos.H, photos.W), (40, 130)])
def test_photos(size: tuple[int, int]) -> None:
    rgb, mask, backdrop = photos.photo(size)
    planes = photos.alphas(size).detach()
    spread = torch.stack([planes] * 2, -1)[..., 0]  # not side by side

    def run() -> list[Tensor]:
        leaf = spread.requires_grad_()
        loss = ops.mask_entropy(leaf, mask, weight=0.3)
        (2 * loss).backward()
        slope, leaf.grad = leaf.grad, None
        masked, whole = (ops.composited(rgb, m, backdrop) for m in (mask, None))
        return [loss.detach(), slope, masked, whole]

    alike(run)
    spread.detach()[0, 0] = torch.nan
    with emulated():
        assert bool(ops.mask_entropy(spread.detach(), mask).isnan())


@pytest.fixture(params=[True, False], ids=["tensor cores", "multiply-adds"])
def products(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_fused, "TENSOR_CORES", request.param)


@pytest.mark.usefixtures("products")
@pytest.mark.parametrize("count", [0, 1, 63, 64, 200])
@pytest.mark.parametrize("cap", [None, 0.5])
def test_network(count: int, cap: float | None) -> None:
    x = networks.points(count)
    alike(lambda: networks.pulled(ops.mlp, x, *networks.network(), exp_cap=cap))


@pytest.mark.usefixtures("products")
@pytest.mark.parametrize(("inputs", "hidden", "outputs"), [(1, 1, 1), (32, 2, 4), (7, 4, 2)])
def test_network_of_any_shape(inputs: int, hidden: int, outputs: int) -> None:
    net = networks.network(inputs, hidden, outputs)
    alike(lambda: networks.pulled(ops.mlp, networks.points(70, inputs), *net))


@pytest.mark.parametrize("size", [*mips.SIZES, (64, 128)])
@pytest.mark.parametrize("count", [1, 300])
def test_sph_mip_lookups(size: tuple[int, int], count: int) -> None:
    base, query = mips.random_map(*size), mips.query(count)
    # the map's gradient is added in whole numbers, each rounded to 2^-42 of the greatest
    alike(lambda: mips.pulled(ops.sph_mip, base, *query))
    if min(size) >= 16:
        alike(lambda: mips.pulled(ops.sph_mip, base, *query, min_level=1.25))


def test_room_to_spare_changes_no_bit_of_the_map_s_gradient() -> None:
    base, (directions, roughness) = mips.random_map(16, 32), mips.query(300)
    slopes = []
    with emulated():
        for room in (100, 300):
            leaf = base.clone().requires_grad_()
            limit = torch.tensor([100])
            out = ops.sph_mip(leaf, directions[:room], roughness[:room], limit=limit)
            out[:100].sin().sum().backward()
            slopes.append(leaf.grad)
    assert torch.equal(*slopes)


def test_sph_mip_passes_on_what_is_not_finite() -> None:
    base, (directions, roughness) = mips.random_map(8, 16), mips.query(5)
    leaf = base.clone().requires_grad_()
    with emulated():
        (ops.sph_mip(leaf, directions, roughness) * torch.inf).sum().backward()
    assert bool(leaf.grad.isnan().all())


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("behind", [False, True])
def test_shading(near: bool, behind: bool) -> None:
    def run() -> list[Tensor]:
        m = shades.maps(3)
        image = shades.shade(ops, m, shades.camera(), near, behind)
        image.backward(torch.linspace(-1, 1, image.numel()).double().reshape(image.shape))
        return [image.detach(), *(v.grad for v in m.values() if v.grad is not None)]

    alike(run)


@pytest.mark.parametrize("edge", [float("inf"), 4.0])
def test_normal_agreement(edge: float) -> None:
    def run() -> list[Tensor]:
        m = shades.maps(4)
        view = shades.camera()
        loss = ops.normal_agreement(m["normal"], m["depth"], m["alpha"], view, edge=edge)
        (3 * loss).backward()
        return [loss.detach(), m["normal"].grad, m["depth"].grad, m["alpha"].grad]

    alike(run)


@pytest.mark.parametrize("order", ORDERS[1:])
def test_the_order_of_threads_changes_nothing(order: int) -> None:
    def run() -> list[Tensor]:
        base, query = mips.random_map(16, 32), mips.query(100)
        m = shades.maps(4)
        agreement = ops.normal_agreement(m["normal"], m["depth"], m["alpha"], shades.camera())
        return [
            *loss_and_gradient((20, 18), True),
            *networks.pulled(ops.mlp, networks.points(70), *networks.network()),
            *mips.pulled(ops.sph_mip, base, *query),
            agreement.detach(),
        ]

    with emulated():
        wanted = run()
    with emulated(order):
        found = run()
    for a, b in zip(found, wanted, strict=True):
        assert torch.equal(a, b)


def adam(dtype: torch.dtype, step: Callable[..., None]) -> list[Tensor]:
    """Values and states after some steps of two optimisers, 34 tensors in all."""
    g = torch.Generator().manual_seed(2)
    sizes = [(1,), (3000, 3), (1024,), (0,), *[(5, 7)] * 30]
    leaves = [torch.randn(*s, generator=g).to(dtype).requires_grad_() for s in sizes]
    first = [{"params": [p], "lr": 0.01 * k} for k, p in enumerate(leaves[:3])]
    made = [torch.optim.Adam(first, eps=1e-15), torch.optim.Adam(leaves[3:], lr=0.1, eps=1e-15)]
    for turn in range(4):
        for k, leaf in enumerate(leaves):
            grad = (torch.randn(leaf.shape, generator=g) * 10.0 ** (k % 5 - 3)).to(dtype)
            leaf.grad = None if k == 7 and turn < 2 else grad
        step(made, turn)
    states = [t for o in made for s in o.state.values() for t in s.values()]
    return [p.detach() for p in leaves] + states


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_adam_is_torchs(dtype: torch.dtype) -> None:
    def torchs(made: list[torch.optim.Adam], turn: int) -> None:
        if turn != 1:
            for optimizer in made:
                optimizer.step()

    def ours(made: list[torch.optim.Adam], turn: int) -> None:
        adam_step(made, torch.tensor(float(turn == 1)))  # a misfit changes nothing

    wanted = adam(dtype, torchs)
    with emulated():
        found = adam(dtype, ours)
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-7 if a.numel() else 0)


def test_rates_on_the_device_are_rates() -> None:
    def by_value(made: list[torch.optim.Adam], turn: int) -> None:
        for optimizer in made:
            for group in optimizer.param_groups:
                group["lr"] *= 0.7
        adam_step(made, None)

    def elsewhere(made: list[torch.optim.Adam], turn: int) -> None:
        by_turn = [rate * 0.7 ** (turn + 1) for rate in rates_of(made)]
        adam_step(made, None, torch.tensor(by_turn, dtype=torch.float64))

    with emulated():
        wanted, found = adam(torch.float64, by_value), adam(torch.float64, elsewhere)
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_a_lens_on_the_device_is_the_camera() -> None:
    m, view = shades.maps(4), shades.camera()
    turned = view.cam_from_world[[1, 2, 0, 3]]
    other = replace(view, cam_from_world=turned, fx=9.0, fy=8.0, cx=5.0, cy=4.0)
    held = replace(other, lens=torch.tensor(view.numbers(), dtype=torch.float64))

    def run(camera: ops.Pinhole) -> list[Tensor]:
        leaves = {k: v.detach().clone().requires_grad_() for k, v in m.items()}
        image = shades.shade(ops, leaves, camera, True, False)
        agreement = ops.normal_agreement(leaves["normal"], leaves["depth"], leaves["alpha"], camera)
        (image.sum() + agreement).backward()
        grads = [v.grad for v in leaves.values() if v.grad is not None]
        return [image.detach(), agreement.detach(), *grads]

    with emulated():
        wanted, found, wrong = run(view), run(held), run(other)
    assert not torch.equal(wrong[0], wanted[0]) and not torch.equal(wrong[1], wanted[1])
    for a, b in zip(found, wanted, strict=True):
        assert torch.equal(a, b)


def test_three_products_of_tf32_are_as_exact_as_floats() -> None:
    """One such product alone is good to three digits; the CPU's floats are the measure."""
    exact = networks.pulled(ops.mlp, networks.points(150), *networks.network())
    single = networks.single(networks.points(150), networks.network())
    usual = networks.pulled(ops.mlp, *single)
    with emulated():
        found = networks.pulled(ops.mlp, *single)
    for a, b, c in zip(found, usual, exact, strict=True):
        error, rounding = (float((v.double() - c).norm() / c.norm()) for v in (a, b))
        assert error < 4 * rounding + 1e-7


def test_floats_are_as_exact_as_the_cpu() -> None:
    def run() -> list[Tensor]:
        image, target, _ = losses.pair(40, 30)
        leaf = image.float().requires_grad_()
        ops.image_loss(leaf, target.float()).backward()
        base = mips.random_map(32, 64).float()
        query = [t.float() for t in mips.query(200)]
        net = networks.single(networks.points(150), networks.network())
        return [
            leaf.grad,
            *networks.pulled(ops.mlp, *net),
            *mips.pulled(ops.sph_mip, base, *query)[:2],
        ]

    alike(run, exact=1e-4)
