"""The network against its definition and against finite differences."""

import itertools
from collections.abc import Callable

import pytest
import torch
from ops.backends import At, Backend
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError
from refdgs_pipe.ops import mlp
from refdgs_pipe.ops.cpu import mlp as on_cpu
from refdgs_pipe.ops.gpu import mlp as on_gpu


def network(
    inputs: int = 10, hidden: int = 3, outputs: int = 3
) -> tuple[list[Tensor], list[Tensor]]:
    g = torch.Generator().manual_seed(1)
    widths = [inputs] + [64] * hidden + [outputs]

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    weights = [normal(b, a) * (2 / a) ** 0.5 for a, b in itertools.pairwise(widths)]
    return weights, [0.1 * normal(b) for b in widths[1:]]


def points(count: int, inputs: int = 10) -> Tensor:
    g = torch.Generator().manual_seed(2)
    return torch.randn(count, inputs, generator=g, dtype=torch.float64)


def pulled(
    run: Callable[..., Tensor],
    x: Tensor,
    weights: list[Tensor],
    biases: list[Tensor],
    **options: float | None,
) -> list[Tensor]:
    """The outputs, and the gradients of a random combination of them."""
    leaves = [t.detach().clone().requires_grad_() for t in (x, *weights, *biases)]
    n = len(weights)
    out = run(leaves[0], leaves[1 : n + 1], leaves[n + 1 :], **options)
    g = torch.Generator().manual_seed(3)
    pull = torch.randn(out.shape, generator=g, dtype=torch.float64).to(out)
    (out * pull).sum().backward()
    return [out.detach(), *(leaf.grad for leaf in leaves)]


def single(
    x: Tensor, net: tuple[list[Tensor], list[Tensor]]
) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    return x.float(), [t.float() for t in net[0]], [t.float() for t in net[1]]


def moved(
    at: At, x: Tensor, net: tuple[list[Tensor], list[Tensor]]
) -> tuple[Tensor, list[Tensor], list[Tensor]]:
    return at(x), [at(t) for t in net[0]], [at(t) for t in net[1]]


@pytest.fixture(params=[True, False], ids=["tensor cores", "multiply-adds"])
def products(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ways in which a GPU multiplies."""
    monkeypatch.setattr(on_gpu, "TENSOR_CORES", request.param)


@pytest.mark.usefixtures("products")
@pytest.mark.parametrize("count", [0, 1, 63, 64, 200])
@pytest.mark.parametrize("cap", [None, 0.5])
def test_outputs_and_gradients_equal_the_definition(
    count: int, cap: float | None, kernels: Backend
) -> None:
    kernels.equals_the_definition(
        lambda at: pulled(mlp, *moved(at, points(count), network()), exp_cap=cap)
    )


@pytest.mark.usefixtures("products")
@pytest.mark.parametrize(
    ("inputs", "hidden", "outputs"), [(1, 1, 1), (16, 2, 4), (17, 1, 2), (32, 8, 3), (7, 4, 2)]
)
def test_other_widths_and_depths_equal_the_definition(
    inputs: int, hidden: int, outputs: int, kernels: Backend
) -> None:
    x, net = points(130, inputs), network(inputs, hidden, outputs)
    kernels.equals_the_definition(lambda at: pulled(mlp, *moved(at, x, net)))


def test_gradients_equal_finite_differences(backend: Backend) -> None:
    weights, biases = network(inputs=2, hidden=1, outputs=2)
    leaves = [t.requires_grad_() for t in (points(3, 2), *weights, *biases)]
    assert torch.autograd.gradcheck(
        lambda x, a, b, c, d: mlp(x, [a, b], [c, d], exp_cap=9.0), leaves, eps=1e-7, atol=1e-6
    )


def test_above_the_cap_a_gradient_only_lowers(backend: Backend) -> None:
    weights, biases = network()
    high = [*biases[:-1], (biases[-1] + 100).requires_grad_()]
    out = mlp(points(70), weights, high, exp_cap=5.0)
    assert float(out.detach().min()) == pytest.approx(float(torch.tensor(5.0).exp()), rel=1e-6)
    (-out).sum().backward(retain_graph=True)
    assert high[-1].grad is not None and not high[-1].grad.any()
    out.sum().backward()
    assert bool((high[-1].grad > 0).all())


def test_float_agrees_with_double_within_its_rounding() -> None:
    x, net = points(5000), network()
    exact = pulled(mlp, x, *net, exp_cap=5.0)
    rough = pulled(mlp, *single(x, net), exp_cap=5.0)
    for a, b in zip(exact, rough, strict=True):
        assert float((a - b.double()).norm() / a.norm()) < 1e-5


def test_half_agrees_with_double_to_three_digits() -> None:
    """Where the CPU cannot, `half` changes nothing, and this holds all the more."""
    x, net = points(5000), network(hidden=1)
    exact, rough = pulled(mlp, x, *net), pulled(mlp, *single(x, net), half=True)
    for a, b in zip(exact, rough, strict=True):
        assert float((a - b.double()).norm() / a.norm()) < 5e-3
    deep = network()  # a rounded value near 0 may fall on the other side of a ReLU: outputs only
    exact_out, rough_out = mlp(x, *deep), mlp(*single(x, deep), half=True)
    assert float((exact_out - rough_out.double()).norm() / exact_out.norm()) < 5e-3


@pytest.mark.parametrize("inputs", [1, 10, 17, 32])
@pytest.mark.parametrize("count", [1, 63, 130])
def test_half_reads_any_number_of_points_and_inputs(inputs: int, count: int) -> None:
    x, net = points(count, inputs), network(inputs, hidden=1, outputs=4)
    exact, rough = pulled(mlp, x, *net), pulled(mlp, *single(x, net), half=True)
    for a, b in zip(exact, rough, strict=True):
        assert float((a - b.double()).norm() / a.norm()) < 0.05


@pytest.mark.parametrize("half", [False, True])
def test_the_result_does_not_depend_on_the_number_of_threads(half: bool) -> None:
    arguments = single(points(20_000), network())
    options = {"exp_cap": 5.0, "half": half}
    results = [pulled(mlp, *arguments, **options, threads=threads) for threads in (1, 2, 7)]
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_any_strides_are_read_as_they_are() -> None:
    x, net = points(100), network()
    planes = x.T.contiguous().T
    wide = torch.cat([x, x], 1)[:, 10:]
    expected = mlp(x, *net)
    assert torch.equal(mlp(planes, *net), expected) and torch.equal(mlp(wide, *net), expected)
    flipped = [w.T.contiguous().T for w in net[0]]
    assert torch.equal(mlp(x, flipped, net[1]), expected)


@pytest.mark.parametrize("half", [False, True])
def test_inputs_may_lie_in_several_tables(half: bool) -> None:
    x, net = points(130), network()
    x, weights, biases = single(x, net) if half else (x, *net)
    whole = x.clone().requires_grad_()
    mlp(whole, weights, biases, half=half).square().sum().backward()
    leaf = x.clone().requires_grad_()
    parts = [leaf[:, :4].T.contiguous().T, leaf[:, 4:8], leaf[:, 8], leaf[:, 9]]
    out = mlp(parts, weights, biases, half=half)
    assert torch.equal(out, mlp(x, weights, biases, half=half))
    out.square().sum().backward()
    assert torch.equal(leaf.grad, whole.grad)
    with pytest.raises(ShapeError, match=r"x is \(5, 4\) and \(6, 6\)"):
        mlp([x[:5, :4], x[:6, 4:]], weights, biases)


def test_values_kept_for_backward_and_values_computed_again_are_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arguments = single(points(5000), network())
    kept = pulled(mlp, *arguments, half=True)
    monkeypatch.setattr(on_cpu, "MOST_KEPT", 0)
    again = pulled(mlp, *arguments, half=True)
    assert all(torch.equal(a, b) for a, b in zip(kept, again, strict=True))


def test_a_point_that_is_not_a_number_spoils_only_itself(backend: Backend) -> None:
    x, weights, biases = single(points(20), network())
    x[3] = float("nan")
    out = mlp(x, weights, biases, exp_cap=5.0)
    assert bool(torch.isfinite(out[torch.arange(20) != 3]).all())
    if backend.name != "emulated":  # there a ReLU makes 0 of it
        assert bool(out[3].isnan().all())


def test_no_points_give_no_outputs_and_zero_gradients(backend: Backend) -> None:
    out, v_x, *v_net = pulled(mlp, points(0), *network())
    assert out.shape == (0, 3) and v_x.shape == (0, 10)
    assert all(float(g.abs().max()) == 0 for g in v_net)


def test_wrong_sizes_are_named() -> None:
    x, (weights, biases) = points(5), network()
    with pytest.raises(ShapeError, match=r"x is \(5, 40\)"):
        mlp(points(5, 40), weights, biases)
    with pytest.raises(ShapeError, match=r"weights\[0\] is \(64, 10\): give \(64, 9\)"):
        mlp(x[:, :9], weights, biases)
    with pytest.raises(ShapeError, match=r"weights\[1\] is \(63, 64\)"):
        mlp(x, [weights[0], weights[1][:63], *weights[2:]], biases)
    with pytest.raises(ShapeError, match="has 5 outputs; at most 4"):
        mlp(x, *network(outputs=5))
    with pytest.raises(ShapeError, match=r"biases\[3\] is \(2,\): give \(3,\)"):
        mlp(x, weights, [*biases[:3], biases[3][:2]])
    with pytest.raises(ShapeError, match="4 weights and 3 biases"):
        mlp(x, weights, biases[:3])
    with pytest.raises(ShapeError, match=r"weights\[2\] is torch.float32"):
        mlp(x, [*weights[:2], weights[2].float(), weights[3]], biases)
    with pytest.raises(DeviceError, match="meta"):
        mlp(x.to("meta"), weights, biases)
