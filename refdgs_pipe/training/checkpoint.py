"""Checkpoints in a folder of their own: tensors only, whole or absent."""

import os
from pathlib import Path

from pydantic import ValidationError
from torch import Tensor

from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.training.settings import TrainParams

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


def settings_of(checkpoint: Checkpoint) -> TrainParams:
    """The settings that a field was trained with so far.

    Raises:
        CorruptError: they are not those of today.
    """
    try:
        return TrainParams.model_validate(checkpoint.settings)
    except ValidationError as error:
        problem = error.errors()[0]["msg"]
        raise CorruptError(f"settings of the checkpoint: {problem}: run `train` again") from None
