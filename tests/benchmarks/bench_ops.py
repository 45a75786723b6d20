"""Fused operations against stock torch, one thread: core-milliseconds, forward and backward.

pytest -m benchmark -s tests/benchmarks/bench_ops.py
"""

import statistics
import time
from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor

from refdgs_pipe.ops import image_loss, reference_image_loss

pytestmark = pytest.mark.benchmark
ROUNDS = 7


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
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
    print(f"\n{name:44s} ours {fast:8.2f}   torch {slow:8.2f}   {slow / fast:6.1f}x", end="")


def with_backward(loss_of: Callable[..., Tensor], *leaves: Tensor) -> Callable[[], object]:
    def work() -> None:
        for leaf in leaves:
            leaf.grad = None
        loss_of(*leaves).backward()

    return work


@pytest.mark.parametrize("size", [400, 800])
def test_image_loss(size: int) -> None:
    g = torch.Generator().manual_seed(0)
    planes = torch.rand(3, size, size, generator=g).requires_grad_()
    target = torch.rand(size, size, 3, generator=g)
    compare(
        f"L1 + SSIM {size}x{size}x3",
        with_backward(lambda p: image_loss(p.permute(1, 2, 0), target), planes),
        with_backward(
            lambda p: reference_image_loss.image_loss(p.permute(1, 2, 0), target), planes
        ),
    )
