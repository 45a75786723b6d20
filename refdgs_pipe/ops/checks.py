"""What every fused operation asks of its tensors."""

import torch
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError
from refdgs_pipe.ops import cuda


def check_alike(first: tuple[str, Tensor], *others: tuple[str, Tensor]) -> None:
    """All tensors are float32 (or all float64, for proofs on the CPU) and on one device.

    Raises:
        ShapeError: types differ or are not floats of 32 or 64 bits.
        DeviceError: they are on several devices, or on one that this build has no kernels for.
    """
    name, tensor = first
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ShapeError(f"{name} is {tensor.dtype}: give float32 (or float64 for proofs)")
    cuda.check_gpu(name, tensor)
    for other_name, other in others:
        if other.dtype != tensor.dtype:
            raise ShapeError(
                f"{other_name} is {other.dtype}, {name} is {tensor.dtype}: give all in one type"
            )
        if other.device != tensor.device:
            raise DeviceError(
                f"{other_name} is on {other.device}, {name} is on {tensor.device}: "
                "give all on one device"
            )
