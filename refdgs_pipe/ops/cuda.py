"""Where the CUDA kernels are, the stream they run on, and the memory they are given."""

from collections.abc import Callable
from functools import partial
from typing import Any

import _refdgs_native as native
import torch
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError
from refdgs_pipe.ops.native import suffix


def check_gpu(name: str, tensor: Tensor) -> None:
    """There are kernels for this tensor.

    Raises:
        DeviceError: it is on a device that this build has no kernels for, or not on torch's current
            GPU.
        ShapeError: it is not float32, the only type that they compute in.
    """
    if tensor.device.type == "cpu":
        return
    if tensor.device.type != "cuda" or not native.cuda_archs:
        raise DeviceError(
            f"{name} is on {tensor.device}, but this build computes on the CPU only: "
            "use --device cpu, or install where nvcc is found"
        )
    if tensor.dtype != torch.float32:
        raise ShapeError(f"{name} is {tensor.dtype}: the GPU computes in float32")
    if tensor.device.index != torch.cuda.current_device():
        raise DeviceError(
            f"{name} is on {tensor.device}, but kernels run on cuda:{torch.cuda.current_device()}: "
            "choose a GPU by CUDA_VISIBLE_DEVICES, or call within torch.cuda.device"
        )


def kernels(name: str, like: Tensor) -> Callable[..., Any]:
    """A function of the native module for the type of `like`, on torch's current stream."""
    found = getattr(native.cuda, f"{name}_{suffix(like)}")
    return partial(found, torch.cuda.current_stream(like.device).cuda_stream)


def processors(like: Tensor) -> int:
    """How many multiprocessors the GPU has."""
    count: int = torch.cuda.get_device_properties(like.device).multi_processor_count
    return count


def sent(tensor: Tensor, device: str) -> Tensor:
    """A tensor of the CPU on a device; neither waits for the other."""
    if device == "cuda":
        tensor = tensor.pin_memory()  # a copy from other memory would be waited for
    return tensor.to(device, non_blocking=True)


def memory(size: int, like: Tensor) -> Tensor:
    """(size,) bytes with unknown content where `like` is; torch keeps them for the next call."""
    return torch.empty(size, dtype=torch.uint8, device=like.device)
