"""The backends of the operations, so that one test runs on all of them."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import _refdgs_native as native
import pytest
import torch
from emulation import emulated
from torch import Tensor

from refdgs_pipe.ops.registry import using

At = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Backend:
    """Where a test's operations are computed, and in which type.

    Args:
        name: definition, cpu, emulated (the kernels of GPUs on the emulated grid) or gpu.
    """

    name: str
    device: str = "cpu"
    dtype: torch.dtype = torch.float64

    def here(self, tensor: Tensor) -> Tensor:
        """A tensor as a leaf of this backend; whole numbers keep their type."""
        kind = self.dtype if tensor.is_floating_point() else tensor.dtype
        return tensor.detach().to(self.device, kind, copy=True)

    def equals_the_definition(
        self, run: Callable[[At], Sequence[Tensor]], exact: float = 1e-9
    ) -> None:
        """What `run` makes here is what plain torch makes of the same in float64."""
        self.agrees(run(self.here), by_definition(run), exact)

    def agrees(
        self, found: Sequence[Tensor], wanted: Sequence[Tensor], exact: float = 1e-9
    ) -> None:
        for a, b in zip(found, wanted, strict=True):
            assert a.shape == b.shape
            scale = float(b.abs().max()) if b.numel() else 1.0
            if self.dtype == torch.float64:  # sums are in another order
                torch.testing.assert_close(a, b, rtol=exact, atol=exact * scale + 1e-15)
            else:  # single pixels and texels fall on the other side of a cut
                assert float((a.cpu().double() - b).norm()) <= 5e-3 * float(b.norm()) + 1e-6


def by_definition(run: Callable[[At], Sequence[Tensor]]) -> Sequence[Tensor]:
    """What plain torch makes in float64."""
    with using("definition"):
        return run(lambda tensor: tensor.detach().clone())


@contextmanager
def running(name: str) -> Iterator[Backend]:
    """Operations are computed by a backend. A GPU's is skipped where there is none."""
    if name == "gpu":
        if not native.cuda_archs or not torch.cuda.is_available():
            pytest.skip("no GPU, or a build without its kernels")
        yield Backend(name, "cuda", torch.float32)
    elif name == "emulated":
        with emulated():
            yield Backend(name)
    else:
        with using("definition" if name == "definition" else "cpu"):
            yield Backend(name)
