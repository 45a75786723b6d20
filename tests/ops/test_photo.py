"""The photo's target and the mask's cross-entropy, against their definition and differences."""

from dataclasses import replace

import pytest
import torch
from ops.backends import At, Backend, by_definition
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError
from refdgs_pipe.ops import composited, mask_entropy

H, W = 21, 37


def photo(size: tuple[int, int] = (H, W)) -> tuple[Tensor, Tensor, Tensor]:
    """Colours, a mask with hard and soft pixels, a backdrop."""
    rng = torch.Generator().manual_seed(3)
    rgb = torch.randint(0, 256, (3, *size), generator=rng, dtype=torch.uint8)
    mask = torch.randint(-200, 456, size, generator=rng).clamp(0, 255).to(torch.uint8)
    return rgb, mask, torch.rand(3, generator=rng, dtype=torch.float64)


def alphas(size: tuple[int, int] = (H, W)) -> Tensor:
    """Alpha maps reach beyond both ends of what counts."""
    made = torch.rand(size, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    return (1.2 * made - 0.1).requires_grad_()


@pytest.mark.parametrize("size", [(1, 1), (H, W), (40, 130)])
def test_a_target_equals_the_definition(size: tuple[int, int], kernels: Backend) -> None:
    rgb, mask, backdrop = photo(size)

    def run(at: At) -> list[Tensor]:
        return [composited(at(rgb), m, at(backdrop)) for m in (at(mask), None)]

    kernels.equals_the_definition(run, exact=1e-12)


@pytest.mark.parametrize("size", [(1, 1), (H, W), (40, 130)])
def test_the_entropy_and_its_gradient_equal_the_definition(
    size: tuple[int, int], kernels: Backend
) -> None:
    _, mask, _ = photo(size)

    def run(at: At) -> list[Tensor]:
        spread = torch.stack([at(alphas(size))] * 2, -1)[..., 0]  # not side by side
        leaf = spread.requires_grad_()
        loss = mask_entropy(leaf, at(mask), weight=0.3)
        (2 * loss).backward()
        return [loss.detach(), leaf.grad]

    kernels.equals_the_definition(run)


def test_float_agrees_with_double_within_its_rounding(kernels: Backend) -> None:
    rgb, mask, backdrop = photo()

    def run(at: At) -> list[Tensor]:
        leaf = at(alphas()).requires_grad_()
        loss = mask_entropy(leaf, at(mask), weight=0.3)
        loss.backward()
        return [composited(at(rgb), at(mask), at(backdrop)), loss.detach(), leaf.grad]

    single = replace(kernels, dtype=torch.float32)
    limits = (3e-7, 1e-5, 2e-4)
    for found, exact, limit in zip(run(single.here), by_definition(run), limits, strict=True):
        assert float((found.cpu().double() - exact).norm() / exact.norm()) < limit


def test_the_entropy_s_gradient_equals_differences(backend: Backend) -> None:
    _, mask, _ = photo()
    leaf = alphas().detach().clamp(0.01, 0.99).requires_grad_()
    assert torch.autograd.gradcheck(lambda a: mask_entropy(a, mask), (leaf,))
    spread = torch.stack([leaf.detach()] * 2, -1)[..., 0].requires_grad_()  # not side by side
    assert torch.equal(mask_entropy(spread, mask), mask_entropy(leaf, mask))


def test_an_alpha_that_is_no_number_is_not_hidden_in_float(backend: Backend) -> None:
    _, mask, _ = photo()
    broken = alphas().detach().float()
    broken[5, 36] = float("nan")
    assert bool(mask_entropy(broken, mask).isnan())


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    rgb, mask, backdrop = photo((150, 40))
    results = []
    for threads in (1, 2, 5):
        leaf = alphas((150, 40)).detach().float().requires_grad_()
        loss = mask_entropy(leaf, mask, threads=threads)
        loss.backward()
        target = composited(rgb, mask, backdrop.float(), threads=threads)
        results.append((target, loss.detach(), leaf.grad))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_wrong_sizes_and_types_are_named() -> None:
    rgb, mask, backdrop = photo()
    with pytest.raises(ShapeError, match="give 21 rows of 37 uint8"):
        mask_entropy(alphas(), mask.float())
    with pytest.raises(ShapeError, match="give 21 rows of 37 uint8"):
        composited(rgb, mask.T, backdrop)
    with pytest.raises(ShapeError, match=r"give \(3, H, W\) uint8"):
        composited(rgb.permute(1, 2, 0), mask, backdrop)
    with pytest.raises(ShapeError, match="at least one pixel"):
        mask_entropy(torch.zeros(0, 4), mask)


def test_tensors_on_several_devices_are_named() -> None:
    rgb, mask, backdrop = photo()
    with pytest.raises(DeviceError, match="mask is on meta, its image on cpu"):
        mask_entropy(alphas(), mask.to("meta"))
    with pytest.raises(DeviceError, match="backdrop is on cpu, rgb is on meta"):
        composited(rgb.to("meta"), None, backdrop)
    with pytest.raises(DeviceError, match="computes on the CPU only"):
        mask_entropy(alphas().to("meta"), mask)
