"""Which device the work runs on."""

import os
from pathlib import Path

from refdgs_pipe.errors import DeviceError, InputError

DEVICES = ("auto", "cpu", "cuda")


def choose_device(wanted: str) -> str:
    """ "cpu" or "cuda". With "auto" a GPU is used if it is there and both libraries can use it.

    Raises:
        InputError: there is no such kind of device.
        DeviceError: "cuda" was asked for and cannot be used.
    """
    if wanted not in DEVICES:
        raise InputError(f"--device {wanted}: expected {', '.join(DEVICES)}")
    if wanted == "cpu" or (wanted == "auto" and not has_driver()):
        return "cpu"
    problem = cuda_problem()
    if problem is None:
        return "cuda"
    if wanted == "cuda":
        raise DeviceError(f"--device cuda: {problem}. Or use --device cpu")
    return "cpu"


def has_driver() -> bool:
    """Whether an NVIDIA driver runs on this machine, found out without loading anything."""
    return Path("/proc/driver/nvidia/version").exists() or Path("/dev/nvidiactl").exists()


def cuda_problem() -> str | None:
    """Why CUDA cannot be used, with what to do about it; None if it can."""
    if not has_driver():
        return "no NVIDIA driver is running. Install the driver of this machine's GPU"
    import torch

    if not torch.cuda.is_available():
        built = f"torch {torch.__version__}"
        return f"{built} sees no GPU. Install a CUDA build of torch that fits the driver"
    import _refdgs_native

    if not _refdgs_native.cuda_archs:
        return "the native module was built without CUDA. Reinstall where nvcc is on the PATH"
    return None


def core_count() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
