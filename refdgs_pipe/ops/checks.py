"""What every fused operation asks of its tensors."""

import torch
from torch import Tensor

from refdgs_pipe.errors import DeviceError, ShapeError


def check_alike(first: tuple[str, Tensor], *others: tuple[str, Tensor]) -> None:
    """All tensors are float32 (or all float64, for proofs) and on the CPU.

    Raises:
        ShapeError: types differ or are not floats of 32 or 64 bits.
        DeviceError: a tensor is elsewhere.
    """
    name, tensor = first
    if tensor.dtype not in (torch.float32, torch.float64):
        raise ShapeError(f"{name} is {tensor.dtype}: give float32 (or float64 for proofs)")
    for other_name, other in (first, *others):
        if other.dtype != tensor.dtype:
            raise ShapeError(
                f"{other_name} is {other.dtype}, {name} is {tensor.dtype}: give all in one type"
            )
        if other.device.type != "cpu":
            raise DeviceError(
                f"{other_name} is on {other.device}, but this build computes on the CPU only: "
                "use --device cpu"
            )
