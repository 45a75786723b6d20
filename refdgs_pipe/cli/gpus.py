"""The GPUs of this machine: which ones there are, and how one of them is chosen."""

import os
import re
import subprocess
from functools import cache
from pathlib import Path

from refdgs_pipe.errors import DeviceError

LEAST_FREE = 2_000_000_000  # bytes; with less, resolution and surfels are lowered early
QUERY_SECONDS = 15


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        names = [name.strip() for name in chosen.split(",")]
        return [name for name in names if re.fullmatch(r"[\w-]+", name) and name != "-1"]
    nodes = [path.name for path in Path("/dev").glob("nvidia*")]
    found = [n.removeprefix("nvidia") for n in nodes if re.fullmatch(r"nvidia\d+", n)]
    return sorted(found, key=int)


@cache
def show_only(index: int) -> None:
    """Let this process, and those that it starts, see one GPU. A second call changes nothing.

    Args:
        index: of `visible_gpus`.

    Raises:
        DeviceError: there is no such GPU, or this process has used one already.
    """
    names = visible_gpus()
    if index >= len(names):
        shown = ["no GPU", "one GPU, cuda:0"][len(names)] if len(names) < 2 else ""
        shown = shown or f"{len(names)} GPUs, cuda:0 to cuda:{len(names) - 1}"
        raise DeviceError(
            f"--device cuda:{index}: this process sees {shown}. Choose one of them, or check "
            "CUDA_VISIBLE_DEVICES"
        )
    import torch

    if torch.cuda.is_initialized():  # type: ignore[no-untyped-call]
        raise DeviceError(
            f"--device cuda:{index}: this process has used a GPU already. Choose it before, by "
            "CUDA_VISIBLE_DEVICES"
        )
    os.environ.setdefault("CUDA_DEVICE_ORDER", "PCI_BUS_ID")  # as nvidia-smi counts
    os.environ["CUDA_VISIBLE_DEVICES"] = names[index]


def mig_problem() -> str | None:
    """What is wrong where all GPUs are divided (MIG) and no part is chosen; else None."""
    modes = _answer("--query-gpu=mig.mode.current", "--format=csv,noheader").split()
    if not modes or any(mode != "Enabled" for mode in modes):
        return None
    parts: list[str] = re.findall(r"MIG-[\w/-]+", _answer("-L"))
    if not parts:
        return (
            "the GPU is divided (MIG) and has no part. Make one, as administrator: "
            "nvidia-smi mig -cgi 0 -C, or turn MIG off: nvidia-smi -mig 0"
        )
    return (
        "the GPU is divided (MIG) and no part is chosen. Choose one: "
        f"CUDA_VISIBLE_DEVICES={parts[0]}"
    )


def _answer(*question: str) -> str:
    """What nvidia-smi says; nothing where it cannot be asked."""
    try:
        done = subprocess.run(
            ["nvidia-smi", *question],
            capture_output=True,
            text=True,
            timeout=QUERY_SECONDS,
            check=False,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout if done.returncode == 0 else ""
