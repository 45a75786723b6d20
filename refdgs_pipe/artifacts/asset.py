"""The exported files: what the user came for."""

import hashlib
import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from refdgs_pipe.errors import CorruptError
from refdgs_pipe.names import fault_of


@dataclass(frozen=True)
class AssetFile:
    """One exported file: its name in the folder, its size and its SHA-256."""

    name: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class Delivery:
    """What was made for one use of the asset.

    Args:
        name: "web", "ar", "game", "film" or "print".
        files: their names in the folder, sorted.
        summary: what they came to, in one line.
        figures: name -> number or text; docs/asset.md has their meaning.
        notes: what to know before using the files.
    """

    name: str
    files: tuple[str, ...]
    summary: str
    figures: dict[str, float | int | str]
    notes: tuple[str, ...] = ()

    @property
    def main_files(self) -> tuple[str, ...]:
        """Those to open; the others are pictures that they refer to."""
        return tuple(name for name in self.files if "/textures/" not in name)


@dataclass(frozen=True)
class Asset:
    """A folder of exported files, each of which passed its validator.

    Args:
        folder: where they are; `asset.json` there lists them.
        files: sorted by name.
        faces, texture_size: what the mesh and its textures weigh.
        targets: what was made for single uses, in the order that was asked for.
    """

    folder: Path
    files: tuple[AssetFile, ...]
    faces: int
    texture_size: int
    targets: tuple[Delivery, ...] = ()

    @classmethod
    def of(
        cls, folder: Path, *, faces: int, texture_size: int, targets: tuple[Delivery, ...] = ()
    ) -> Self:
        """List and hash what lies in a folder."""
        paths = sorted(p for p in folder.rglob("*") if p.is_file() and p.name != "asset.json")
        files = tuple(
            AssetFile(
                p.relative_to(folder).as_posix(),
                p.stat().st_size,
                hashlib.sha256(p.read_bytes()).hexdigest(),
            )
            for p in paths
        )
        return cls(folder, files, faces, texture_size, targets)

    def save(self, folder: Path) -> None:
        """Write asset.json; the files are copied unless they are there."""
        if folder != self.folder:
            for file in self.files:
                (folder / file.name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(self.folder / file.name, folder / file.name)
        record: dict[str, Any] = {
            "faces": self.faces,
            "texture_size": self.texture_size,
            "files": [asdict(file) for file in self.files],
        }
        if self.targets:
            record["targets"] = [asdict(delivery) for delivery in self.targets]
        (folder / "asset.json").write_text(json.dumps(record, indent=1), encoding="utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        try:
            record = json.loads((folder / "asset.json").read_text(encoding="utf-8"))
            files = tuple(AssetFile(**file) for file in record["files"])
            for file in files:
                if fault := fault_of(file.name):
                    raise ValueError(f"{file.name}: {fault}")
            targets = tuple(_delivery(made) for made in record.get("targets", ()))
            return cls(folder, files, record["faces"], record["texture_size"], targets)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CorruptError(f"asset.json: {error}") from error


def _delivery(record: dict[str, Any]) -> Delivery:
    files, notes = tuple(record["files"]), tuple(record["notes"])
    return Delivery(record["name"], files, record["summary"], dict(record["figures"]), notes)
