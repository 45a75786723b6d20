"""The surface of a field in training, for surfels to start anew on."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.errors import CorruptError


@dataclass(frozen=True)
class Shape:
    """What a field's views agree on.

    Args:
        mesh: cleaned and fitted to the views; None where none is needed, or none could be made.
        why_not: why none could be made; "" else.
    """

    mesh: TriangleMesh | None
    why_not: str = ""

    def save(self, folder: Path) -> None:
        if self.mesh is not None:
            self.mesh.save(folder)
        record = {"mesh": self.mesh is not None, "why_not": self.why_not}
        (folder / "shape.json").write_text(json.dumps(record), "utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: a file is missing or damaged.
        """
        try:
            record = json.loads((folder / "shape.json").read_text("utf-8"))
            mesh = TriangleMesh.load(folder) if record["mesh"] else None
            return cls(mesh, str(record["why_not"]))
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise CorruptError(
                f"{folder}: not a readable shape ({error}): run the stage shape again"
            ) from error
