"""How large the exported asset is, read from the head of its GLB."""

import json
import struct
from dataclasses import dataclass
from pathlib import Path

_MAGIC, _JSON = 0x46546C67, 0x4E4F534A
_MOST = 64_000_000  # bytes of a JSON chunk that is read


@dataclass(frozen=True)
class Dimensions:
    """Sides of the asset's box in metres: to the right (X), upwards (Y), to the front (Z)."""

    width: float
    height: float
    depth: float

    @property
    def words(self) -> str:
        """Width x height x depth, in the unit that suits the largest: "23.0 x 14.2 x 15.1 cm"."""
        largest = max(self.width, self.height, self.depth)
        unit, scale = ("m", 1.0) if largest >= 1 else ("cm", 100.0)
        if largest < 0.01:
            unit, scale = "mm", 1000.0
        sides = (f"{side * scale:.3g}" for side in (self.width, self.height, self.depth))
        return f"{' x '.join(sides)} {unit}"


def dimensions(path: Path) -> Dimensions | None:
    """The box of all positions in a GLB; None where the file does not tell."""
    try:
        with path.open("rb") as file:
            magic, _, _, length, kind = struct.unpack("<5I", file.read(20))
            if magic != _MAGIC or kind != _JSON or length > _MOST:
                return None
            document = json.loads(file.read(length))
        used = {p["attributes"]["POSITION"] for m in document["meshes"] for p in m["primitives"]}
        boxes = [document["accessors"][index] for index in used]
        low = [min(box["min"][i] for box in boxes) for i in range(3)]
        high = [max(box["max"][i] for box in boxes) for i in range(3)]
        width, height, depth = (float(b) - float(a) for a, b in zip(low, high, strict=True))
    except (OSError, ValueError, KeyError, IndexError, TypeError, struct.error):
        return None
    return Dimensions(width, height, depth)


def is_size_known(told: str) -> bool:
    """Whether what the export says of the size is a size, and not a guess."""
    return not told.startswith("unknown")
