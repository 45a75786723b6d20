"""The CUDA kernels on the emulated grid, and memory that notices what it should not see."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from refdgs_pipe.ops import cuda, native
from refdgs_pipe.ops.registry import using

GUARD = 64  # bytes before and after; 0xff.. is a NaN in every float type
ORDERS = [0, 1, 7]  # threads first to last, last to first, and shuffled


class Guarded:
    """Hands out memory full of NaN between guards."""

    def __init__(self) -> None:
        self.blocks: list[Tensor] = []

    def __call__(self, size: int, like: Tensor) -> Tensor:
        block = torch.full((size + 2 * GUARD,), 255, dtype=torch.uint8)
        self.blocks.append(block)
        return block[GUARD : GUARD + size]

    def new_empty(self, like: Tensor, *size: Any, dtype: torch.dtype | None = None) -> Tensor:
        """Instead of `Tensor.new_empty`."""
        shape = torch.Size(size[0] if size and isinstance(size[0], tuple | list) else size)
        kind = dtype or like.dtype
        block = self(shape.numel() * kind.itemsize, like).view(kind).view(shape)
        return block if kind.is_floating_point else block.fill_(7)

    def empty_like(self, like: Tensor) -> Tensor:
        """Instead of `torch.empty_like`."""
        return self.new_empty(like, tuple(like.shape))

    def check(self) -> None:
        for block in self.blocks:
            assert bool((block[:GUARD] == 255).all()) and bool((block[-GUARD:] == 255).all())


@contextmanager
def emulated(order: int = 0) -> Iterator[None]:
    """Every operation on CPU tensors runs the CUDA kernels, thread by thread on the CPU."""
    module = pytest.importorskip("_refdgs_emulated")
    memory = Guarded()

    def kernels(name: str, like: Tensor) -> Callable[..., Any]:
        return partial(getattr(module, f"{name}_{native.suffix(like)}"), order)

    def memory_like(like: Tensor, *size: Any, **kind: torch.dtype) -> Tensor:
        return memory.new_empty(like, *size, **kind)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda, "kernels", kernels)
        patch.setattr(cuda, "memory", memory)
        patch.setattr(
            Tensor, "new_empty", lambda like, *size, **kind: memory.new_empty(like, *size, **kind)
        )
        patch.setattr(torch, "empty_like", memory.empty_like)
        patch.setattr(cuda, "processors", lambda like: 1)
        with using("gpu"):
            yield
    memory.check()
