"""What only the kernels of GPUs have, on the emulated grid; the rest is in test_<operation>."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from emulation import ORDERS, emulated
from ops import test_image_loss as losses
from ops import test_mlp as networks
from ops import test_shade as shades
from ops import test_sph_mip as mips
from torch import Tensor

from refdgs_pipe import ops
from refdgs_pipe.ops import adam_step, rates_of


def loss_and_gradient(size: tuple[int, int], weighted: bool) -> list[Tensor]:
    image, target, weight = losses.pair(*size)
    leaf = image.clone().requires_grad_()
    loss, error = ops.image_loss_and_error(
        leaf, target, weight=weight if weighted else None, ssim_share=0.3
    )
    assert not error.requires_grad
    (2.5 * loss).backward()
    return [loss.detach(), error, leaf.grad, ops.ssim_map(image, target)]


def smoothness() -> list[Tensor]:
    normal, *rest = shades.solid_maps(4, size=(21, 70))
    loss = ops.normal_smoothness(normal, *rest, shaded=0.3, weight=0.2)
    loss.backward()
    return [loss.detach(), normal.grad]


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
            *smoothness(),
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
        image = shades.shade(leaves, camera, True, False)
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

    wanted = run()
    with emulated():
        found = run()
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4 * float(b.abs().max()))
