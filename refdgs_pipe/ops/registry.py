"""Which kernels compute an operation: every one is declared once, with one for each backend."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

Backend = Literal["definition", "cpu", "gpu"]
Kernel = type[torch.autograd.Function] | Callable[..., Any]

OPERATIONS: dict[str, "Operation"] = {}
_chosen: ContextVar[Backend | None] = ContextVar("backend", default=None)


@dataclass(frozen=True)
class Operation:
    """An operation and its kernels, which take the same arguments in the same order.

    A kernel ignores the arguments that are of other backends only (threads, room for lists).

    Args:
        name: of the public function that checks the arguments.
        definition: in plain torch, which differentiates it; any precision, slow.
        cpu: compiled for the CPU.
        gpu: compiled for GPUs; tests run the same code on an emulated grid.
    """

    name: str
    definition: Kernel
    cpu: Kernel
    gpu: Kernel

    def __post_init__(self) -> None:
        OPERATIONS[self.name] = self

    def kernel(self, on: Tensor) -> Callable[..., Any]:
        """The function that computes the operation where a tensor is."""
        found = getattr(self, backend_of(on))
        kernel: Callable[..., Any] = getattr(found, "apply", found)
        return kernel


def backend_of(tensor: Tensor) -> Backend:
    """Whose kernels compute what is asked of a tensor: its device's, if `using` says nothing."""
    return _chosen.get() or ("gpu" if tensor.device.type == "cuda" else "cpu")


@contextmanager
def using(backend: Backend) -> Iterator[None]:
    """Operations are computed by these kernels, wherever their tensors are; for tests."""
    before = _chosen.set(backend)
    try:
        yield
    finally:
        _chosen.reset(before)
