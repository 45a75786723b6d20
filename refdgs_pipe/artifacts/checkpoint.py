"""A field whose training is not through, with all that it takes to go on."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.errors import CorruptError


@dataclass(frozen=True)
class Checkpoint:
    """A field as it is between two stages of its training.

    Args:
        field: as it is drawn now.
        tensors: what is optimised, the optimisers' moments and the random numbers, by name; empty
            if training is through.
        figures: how far training is and how it goes, by name.
        settings: those that it is trained with.
        max_side: longest side of the photos that it is trained on, pixels.
        shown: how much of the object the field shows, 0 to 1.
    """

    field: SurfelField
    tensors: Mapping[str, NDArray[Any]]
    figures: Mapping[str, Any]
    settings: Mapping[str, Any]
    max_side: int
    shown: float

    @property
    def is_last(self) -> bool:
        """Whether training is through."""
        return not self.tensors

    def save(self, folder: Path) -> None:
        from safetensors.numpy import save_file

        self.field.save(folder)
        arrays = {name: np.asarray(values, order="C") for name, values in self.tensors.items()}
        save_file(arrays, folder / "state.safetensors")
        record = {
            "figures": dict(self.figures),
            "settings": dict(self.settings),
            "max_side": self.max_side,
            "shown": self.shown,
        }
        (folder / "state.json").write_text(json.dumps(record, indent=2), "utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: a file is missing or damaged.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        field = SurfelField.load(folder)
        try:
            tensors = load_file(folder / "state.safetensors")
            record = json.loads((folder / "state.json").read_text("utf-8"))
            return cls(
                field,
                tensors,
                dict(record["figures"]),
                dict(record["settings"]),
                int(record["max_side"]),
                float(record["shown"]),
            )
        except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
            raise CorruptError(
                f"{folder}: not a readable checkpoint ({error}): run the stage train again"
            ) from error
