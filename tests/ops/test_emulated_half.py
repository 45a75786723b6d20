"""The network's kernels with bfloat16 products, on the emulated grid.

A double is not rounded there: it proves which number a lane has where.
"""

import pytest
import torch
from emulation import ORDERS, emulated
from ops.test_mlp import network, points, pulled, single
from torch import Tensor

from refdgs_pipe.ops import mlp
from refdgs_pipe.ops.gpu import mlp as on_gpu


@pytest.mark.parametrize("outputs", [1, 3, 4])
@pytest.mark.parametrize("inputs", [1, 8, 14, 15])
@pytest.mark.parametrize("count", [1, 63, 200])
def test_in_doubles_it_is_the_definition(count: int, inputs: int, outputs: int) -> None:
    x, net = points(count, inputs), network(inputs, outputs=outputs)
    cap = 0.5 if outputs == 3 else None
    wanted = pulled(mlp, x, *net, exp_cap=cap)
    with emulated():
        found = pulled(mlp, x, *net, exp_cap=cap, half=True)
        usual = pulled(mlp, x, *net, exp_cap=cap)
    assert not all(torch.equal(a, b) for a, b in zip(found, usual, strict=True))  # other kernels
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9 * float(b.abs().max()))


def test_floats_agree_with_doubles_to_three_digits() -> None:
    x, net = points(600), network()
    exact = pulled(mlp, x, *net)
    with emulated():
        rough = pulled(mlp, *single(x, net), half=True)
    errors = [float((a - b.double()).norm() / a.norm()) for a, b in zip(exact, rough, strict=True)]
    assert 1e-4 < errors[0] < 5e-3
    assert max(errors) < 0.1  # a rounded value near 0 may fall on the other side of a ReLU


def test_what_goes_in_and_out_is_not_rounded() -> None:
    """With hidden values that bfloat16 holds exactly, the result is a float's."""
    g = torch.Generator().manual_seed(4)
    x = torch.rand(40, 8, generator=g) + 1
    weights = [torch.eye(64, 8), torch.eye(64), torch.eye(64), torch.rand(3, 64, generator=g)]
    biases = [torch.zeros(64)] * 3 + [torch.rand(3, generator=g)]
    steps = (8 * x).round() / 8
    with emulated():
        out = mlp(steps, weights, biases, half=True)
    torch.testing.assert_close(out, mlp(steps, weights, biases), rtol=1e-6, atol=1e-6)
    shifted = [1e-3 * weights[0].sum(1), *biases[1:]]
    with emulated():
        apart = mlp(steps - 1e-3, weights, shifted, half=True)
    torch.testing.assert_close(apart, out, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("order", ORDERS[1:])
def test_the_order_of_threads_changes_no_bit(order: int) -> None:
    arguments = single(points(150), network())
    found = []
    for turn in (0, order):
        with emulated(turn):
            found.append(pulled(mlp, *arguments, half=True))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_rows_beyond_the_limit_and_tables_side_by_side_change_no_bit() -> None:
    x, weights, biases = single(points(130), network())

    def run(x: Tensor, tables: list[Tensor], count: int) -> list[Tensor]:
        net = [t.clone().requires_grad_() for t in (*weights, *biases)]
        out = mlp(tables, net[:4], net[4:], half=True, limit=torch.tensor([count]))
        out[:count].square().sum().backward()
        return [out[:count].detach(), x.grad[:count], *(t.grad for t in net)]

    found = []
    with emulated():
        for room in (70, 130):
            leaf = x[:room].clone().requires_grad_()
            whole = [leaf] if room == 70 else [leaf[:, :4], leaf[:, 4:8], leaf[:, 8], leaf[:, 9]]
            found.append(run(leaf, whole, 70))
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def test_other_networks_and_no_tensor_cores_take_the_exact_kernels(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for net, inputs in ((network(hidden=2), 10), (network(16), 16)):
        x, weights, biases = single(points(20, inputs), net)
        with emulated():
            assert torch.equal(mlp(x, weights, biases, half=True), mlp(x, weights, biases))
    x, weights, biases = single(points(20), network())
    monkeypatch.setattr(on_gpu, "TENSOR_CORES", False)
    with emulated():
        assert torch.equal(mlp(x, weights, biases, half=True), mlp(x, weights, biases))
