"""Checkpoints: tensors only, whole or absent."""

import os
from pathlib import Path

from torch import Tensor

NAME = "checkpoint.safetensors"


def write_checkpoint(folder: Path, tensors: dict[str, Tensor], figures: str) -> None:
    """Replace the folder's checkpoint in one rename."""
    from safetensors.torch import save_file

    partial = folder / f".{NAME}"
    save_file(
        {k: v.contiguous() for k, v in tensors.items()}, partial, metadata={"figures": figures}
    )
    with partial.open("rb") as file:
        os.fsync(file.fileno())
    partial.replace(folder / NAME)


def read_checkpoint(folder: Path) -> tuple[dict[str, Tensor], str] | None:
    """The folder's checkpoint, or None if there is none or it cannot be read (then start again)."""
    from safetensors import SafetensorError, safe_open

    path = folder / NAME
    if not path.exists():
        return None
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return tensors, file.metadata()["figures"]
    except (SafetensorError, OSError, KeyError, TypeError):
        return None
