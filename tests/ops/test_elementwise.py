"""What lies between the other operations, against plain torch."""

import pytest
import torch
from emulation import ORDERS, emulated
from ops.backends import At, Backend
from torch import Tensor

from refdgs_pipe import ops
from refdgs_pipe.ops.gpu.elementwise import unit


def random(*shape: int, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed + sum(shape))
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def given(leaves: list[Tensor]) -> list[Tensor]:
    return [leaf.grad for leaf in leaves if leaf.grad is not None]


@pytest.mark.parametrize("n", [300, 0])
@pytest.mark.parametrize("names", [("diffuse", "sigmoid", "tanh"), ("tanh",), ()])
def test_activations_and_their_gradients_equal_the_definition(
    names: tuple[str, ...], n: int, kernels: Backend
) -> None:
    widths = {"diffuse": 3, "sigmoid": 0, "tanh": 4}

    def run(at: At) -> list[Tensor]:
        raw = [random(n, 2), random(n)]
        raw += [3 * random(n, widths[k]) if widths[k] else random(n, seed=1) for k in names]
        leaves = [at(t).requires_grad_() for t in raw]
        out = ops.activated(leaves[0], leaves[1], list(zip(names, leaves[2:], strict=True)))
        assert out[2].shape == (n, sum(widths[k] or 1 for k in names))
        sum(
            (t * torch.linspace(-1, 2, t.numel()).to(t).reshape(t.shape)).sum() for t in out
        ).backward()
        return [t.detach() for t in out] + given(leaves)

    kernels.equals_the_definition(run)


@pytest.mark.parametrize("misfit", [None, 0.0, 1.0])
def test_observations_equal_the_definition(misfit: float | None, kernels: Backend) -> None:
    def run(at: At) -> list[Tensor]:
        sets = []
        for n in (300, 0, 41):
            radii = at(random(n, seed=3).clamp(min=0))
            sets.append((at(random(n)), at(random(n, seed=1)), at(random(n, 2)), radii))
        told = None if misfit is None else torch.tensor(misfit, device=sets[0][0].device)
        ops.observe(sets, scale=7.5, misfit=told)
        return [t for one in sets for t in one[:2]]

    kernels.equals_the_definition(run)


def test_damping_equals_the_definition(kernels: Backend) -> None:
    def run(at: At) -> list[Tensor]:
        light = [at(random(3, 290, seed=k).abs()).T for k in (1, 2)]
        light[0][:5], light[1][:9] = 0, 0
        return [ops.damped(at(random(290, 3)), *light, 0.5)]

    kernels.equals_the_definition(run)


@pytest.mark.parametrize("whole", [False, True])
def test_means_and_their_total_equal_the_definition(whole: bool, kernels: Backend) -> None:
    """Told by 1 or by another number, which the kept gradients are scaled by."""
    size = (21, 150)
    mask = (255 * random(*size).abs().clamp(max=1)).to(torch.uint8)
    pixels = torch.arange(700)
    pixels[650:] = -1

    def run(at: At) -> list[Tensor]:
        leaves = [at(random(*size).abs()).requires_grad_() for _ in range(2)]
        radiance = at(random(700, 3)).requires_grad_()

        def loss() -> Tensor:
            terms = [
                ops.image_mean(leaves[0], weight=0.3, divisor=0.01, whole=whole),
                ops.mirrored(radiance, at(pixels), 3150, weight=0.2, whole=whole),
                ops.mask_entropy(leaves[1], at(mask), weight=0.7, whole=whole),
                leaves[1].square().mean(),
            ]
            return ops.total(terms)

        out = [loss().detach()]
        for factor in (1.0, 2.5):
            ops.descend(loss() if factor == 1 else factor * loss())
            rows = radiance.grad[:650] if radiance.grad is not None else radiance
            out += [t.clone() for t in (*given(leaves), rows)]
        return out

    kernels.equals_the_definition(run)


def test_one_is_told_without_a_copy_and_a_single_term_is_its_own_total() -> None:
    with emulated():
        alpha = random(9, 70).abs().requires_grad_()
        mask = torch.zeros(9, 70, dtype=torch.uint8)
        loss = ops.total([ops.mask_entropy(alpha, mask, whole=False)])
        wanted = ops.mask_entropy(alpha, mask)
        assert loss.item() == pytest.approx(wanted.item())
        assert unit(loss) is unit(alpha)


@pytest.mark.parametrize("order", ORDERS[1:])
def test_the_order_of_threads_changes_no_sum(order: int) -> None:
    def run() -> list[Tensor]:
        m = [random(40, 90, seed=k).float() for k in range(2)]
        return [ops.total([ops.image_mean(t, whole=False) for t in m]), ops.image_mean(m[0])]

    with emulated():
        wanted = run()
    with emulated(order):
        found = run()
    assert all(torch.equal(a, b) for a, b in zip(found, wanted, strict=True))
