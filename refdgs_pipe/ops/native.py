"""The native module as a whole: what it runs on, and its memory."""

from collections.abc import Callable
from typing import Any

import _refdgs_native as native
import torch
from torch import Tensor


def isa() -> str:
    """The instruction set in use: avx512, avx2 or baseline."""
    return str(native.isa())


def keep_freed_memory() -> None:
    """Tell the allocator to reuse what is freed instead of returning it; for long training runs."""
    native.keep_freed_memory()


def suffix(like: Tensor) -> str:
    """How the native functions for this tensor's type end."""
    return "float" if like.dtype == torch.float32 else "double"


def kernels(name: str, like: Tensor) -> Callable[..., Any]:
    """A function of the CPU for the type of `like`."""
    found: Callable[..., Any] = getattr(native, f"{name}_{suffix(like)}")
    return found
