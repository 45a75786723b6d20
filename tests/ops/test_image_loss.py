"""L1 + SSIM against its definition and against finite differences."""

import pytest
import torch
from ops.backends import At, Backend
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError
from refdgs_pipe.ops import image_loss, image_loss_and_error, ssim, ssim_map

SIZES = [(1, 1), (3, 200), (33, 5), (37, 29)]


def pair(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Two similar images and weights, a quarter of which are zero."""
    g = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=g, dtype=torch.float64)
    noise = 0.2 * torch.randn(height, width, 3, generator=g, dtype=torch.float64)
    weight = torch.rand(height, width, generator=g, dtype=torch.float64)
    weight = torch.where(weight < 0.25, 0.0, weight)
    weight.view(-1)[0] = 0.5
    return target + noise, target, weight


@pytest.mark.parametrize("weighted", [False, True])
def test_the_squared_error_is_the_weighted_mean_in_float_and_double(weighted: bool) -> None:
    rng = torch.Generator().manual_seed(8)
    image, target = torch.rand(2, 30, 41, 3, generator=rng, dtype=torch.float64).unbind(0)
    weight = (torch.rand(30, 41, generator=rng) < 0.7).double() if weighted else None
    share = torch.ones(30, 41) if weight is None else weight
    expected = float(((image - target) ** 2 * share[..., None]).sum() / share.sum() / 3)
    for dtype in (torch.float64, torch.float32):
        w = None if weight is None else weight.to(dtype)
        leaf = image.to(dtype).requires_grad_()
        loss, error = image_loss_and_error(leaf, target.to(dtype), weight=w)
        loss = loss.detach()
        assert not error.requires_grad and float(error) == pytest.approx(expected, rel=1e-5)
        assert torch.equal(loss, image_loss(leaf, target.to(dtype), weight=w).detach())


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("weighted", [False, True])
def test_loss_error_gradient_and_map_equal_the_definition(
    size: tuple[int, int], weighted: bool, kernels: Backend
) -> None:
    image, target, weight = pair(*size)

    def run(at: At) -> list[Tensor]:
        leaf = at(image).requires_grad_()
        loss, error = image_loss_and_error(
            leaf, at(target), weight=at(weight) if weighted else None, ssim_share=0.3
        )
        assert not error.requires_grad
        (2.5 * loss).backward()
        return [loss.detach(), error, leaf.grad, ssim_map(at(image), at(target))]

    kernels.equals_the_definition(run)


def test_the_gradient_equals_finite_differences(backend: Backend) -> None:
    image, target, weight = pair(17, 9)
    leaf = image.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: image_loss(x, target, weight=weight), (leaf,))


def test_ssim_is_the_mean_of_its_map(backend: Backend) -> None:
    image, target, _ = pair(37, 29)
    mean = float(ssim_map(image, target).mean())
    assert ssim(image, target) == pytest.approx(mean, rel=1e-12)


def test_equal_images_lose_nothing_and_pull_nowhere(backend: Backend) -> None:
    _, target, _ = pair(40, 33)
    leaf = target.clone().requires_grad_()
    loss = image_loss(leaf, target)
    loss.backward()
    assert abs(float(loss.detach())) < 1e-12
    assert float(leaf.grad.abs().max()) < 1e-12
    assert ssim(target, target) == pytest.approx(1, abs=1e-12)


def test_float_agrees_with_double_within_its_rounding() -> None:
    """Smooth areas are the hard case: variances are small differences of squares."""
    image, target, weight = pair(150, 140)
    smooth = 0.9 + 0.001 * image
    smooth[40:90] = image[40:90]
    exact = smooth.clone().requires_grad_()
    rough = smooth.float().requires_grad_()
    loss = image_loss(exact, target, weight=weight)
    loss.backward()
    single = image_loss(rough, target.float(), weight=weight.float())
    single.backward()
    assert float(single.detach()) == pytest.approx(float(loss.detach()), rel=1e-5)
    error = float((rough.grad.double() - exact.grad).norm() / exact.grad.norm())
    assert error < 1e-4


def test_planar_interleaved_and_cut_out_images_give_the_same_bits(kernels: Backend) -> None:
    image, target, weight = (kernels.here(t).float() for t in pair(70, 61))
    planar = image.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    wide = torch.zeros(70, 99, 4, device=kernels.device)
    wide[:, 13:74, :3] = target
    results = []
    for x, y in ((image, target), (planar, target), (image, wide[:, 13:74, :3])):
        leaf = x.detach().requires_grad_()
        image_loss(leaf, y, weight=weight).backward()
        results.append(leaf.grad)
    assert all(torch.equal(results[0], other) for other in results[1:])


def test_the_gradient_comes_in_planes() -> None:
    image, target, _ = pair(20, 30)
    seen: list[tuple[int, ...]] = []
    leaf = image.permute(2, 0, 1).contiguous().requires_grad_()
    view = leaf.permute(1, 2, 0)
    view.register_hook(lambda g: seen.append(g.stride()))
    image_loss(view, target).backward()
    assert seen == [(30, 1, 600)]


def test_the_result_does_not_depend_on_the_number_of_threads() -> None:
    image, target, weight = (t.float() for t in pair(300, 97))
    results = []
    for threads in (1, 2, 7):
        leaf = image.clone().requires_grad_()
        loss = image_loss(leaf, target, weight=weight, threads=threads)
        loss.backward()
        results.append((loss.detach(), leaf.grad))
    for loss, gradient in results[1:]:
        assert torch.equal(loss, results[0][0]) and torch.equal(gradient, results[0][1])


def test_without_weight_anywhere_the_loss_and_its_gradient_are_zero(backend: Backend) -> None:
    image, target, weight = pair(20, 20)
    leaf = image.clone().requires_grad_()
    loss = image_loss(leaf, target, weight=0 * weight)
    loss.backward()
    assert float(loss.detach()) == 0 and float(leaf.grad.abs().max()) == 0


def test_an_empty_image_loses_nothing_but_has_no_ssim(kernels: Backend) -> None:
    empty = kernels.here(torch.zeros(0, 5, 3)).requires_grad_()
    loss = image_loss(empty, empty.detach())
    loss.backward()
    assert float(loss.detach()) == 0 and empty.grad.shape == (0, 5, 3)
    assert ssim_map(empty, empty.detach()).shape == (0, 5, 3)
    with pytest.raises(ShapeError, match="mean of nothing"):
        ssim(empty, empty.detach())


def test_wrong_sizes_types_and_gradients_are_named() -> None:
    image, target, weight = pair(8, 9)
    with pytest.raises(ShapeError, match=r"target is \(8, 8, 3\) but image is \(8, 9, 3\)"):
        image_loss(image, target[:, :8])
    with pytest.raises(ShapeError, match=r"weight is \(9, 8\)"):
        image_loss(image, target, weight=weight.T)
    with pytest.raises(ShapeError, match=r"give \(H, W, C\)"):
        image_loss(image[0], target[0])
    with pytest.raises(ShapeError, match=r"target is torch.float32"):
        image_loss(image, target.float())
    with pytest.raises(ShapeError, match="float32"):
        image_loss(image.half(), target.half())
    with pytest.raises(ShapeError, match="detach"):
        image_loss(image, target.requires_grad_())
    with pytest.raises(ShapeError, match="ssim_share is 2"):
        image_loss(image, target.detach(), ssim_share=2)
    with pytest.raises(DeviceError, match="meta"):
        image_loss(image.to("meta"), target.detach())
