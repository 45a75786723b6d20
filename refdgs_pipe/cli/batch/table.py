"""A batch on disk: its captures, and where their workspaces and results are. docs/batch.md."""

import csv
import io
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from refdgs_pipe import recipe
from refdgs_pipe.cli.workspace import Memory, Workspace, open_workspace
from refdgs_pipe.documents import parse_json, read_text
from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline.atomic import disk_errors, write_json, write_text

TABLE, NOTE = "captures.tsv", "batch.json"
FORMAT = 1
COLUMNS = ("capture", "photos", "recipe", "set")
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
_UNSAFE = re.compile(r"[^A-Za-z0-9._-]+")
_LIMIT = 256_000_000  # bytes of a table, some million captures


@dataclass(frozen=True)
class Capture:
    """One row of the table.

    Args:
        name: of its workspace and of its jobs.
        photos: a folder, an archive or a video; absolute.
        recipe: a name, or the absolute path of a TOML file.
        assignments: `stage.key=value`, as --set takes them.
    """

    name: str
    photos: Path
    recipe: str = recipe.DEFAULT
    assignments: tuple[str, ...] = ()


@dataclass(frozen=True)
class Batch:
    """A folder that `batch init` made.

    Args:
        cache: where results are shared; None: nowhere.
    """

    root: Path
    captures: tuple[Capture, ...]
    cache: str | None = None

    @classmethod
    def read(cls, root: Path) -> "Batch":
        """Read the table and the note of a batch.

        Raises:
            InputError: it is no batch, or its table says what cannot be meant.
            CorruptError: its note is damaged.
        """
        try:
            note = parse_json(read_text(root / NOTE))
            if note["format"] > FORMAT:
                raise InputError(f"{printable(root)}: a newer refdgs-pipe made this. Update it")
            cache = None if note["cache"] is None else str(note["cache"])
        except (FileNotFoundError, NotADirectoryError):
            raise InputError(
                f"{printable(root)}: not a batch. Make one: refdgs-pipe batch init CAPTURES... "
                f"--out {printable(root)}"
            ) from None
        except (ValueError, KeyError, TypeError) as error:
            raise CorruptError(
                f"{printable(root / NOTE)}: damaged ({printable(error)}). Write it anew, as in "
                '{"format": 1, "cache": null}'
            ) from None
        return cls(root, _read_table(root), cache)

    def write(self) -> None:
        """Write the table and the note.

        Raises:
            InputError: a path cannot stand in a table.
            WriteError: the folder cannot be written.
        """
        text = _table_text(self.captures)
        with disk_errors(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            write_text(self.root / TABLE, text)
            write_json(self.root / NOTE, {"format": FORMAT, "cache": self.cache})

    def capture(self, name: str) -> Capture:
        """The capture of that name.

        Raises:
            InputError: there is none.
        """
        for found in self.captures:
            if found.name == name:
                return found
        raise InputError(f"{self.root / TABLE}: no capture is called {printable(name)}")

    def workspace(self, capture: Capture) -> Path:
        """Where a capture's workspace is, or will be."""
        return self.root / "workspaces" / f"{capture.name}.refdgs"

    def open(self, capture: Capture) -> Workspace:
        """A capture's workspace, with the photos and settings of the table.

        Raises:
            InputError: the settings are wrong.
        """
        memory = Memory((capture.photos,), capture.recipe, capture.assignments)
        return open_workspace(self.workspace(capture), memory, tell=lambda _: None)


def named(paths: Sequence[Path], taken: Iterable[str]) -> list[tuple[str, Path]]:
    """A name for each path: that of its folder or file, with a number where two are alike."""
    used, found = set(taken), []
    for path in paths:
        stem = path.stem if path.is_file() else path.name
        plain = _UNSAFE.sub("-", stem).strip("-._")[:80] or "capture"
        name, number = plain, 1
        while name in used:
            number += 1
            name = f"{plain}-{number}"
        used.add(name)
        found.append((name, path))
    return found


def _read_table(root: Path) -> tuple[Capture, ...]:
    path = root / TABLE
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path, limit=_LIMIT)), delimiter="\t"))
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"{printable(path)}: cannot be read ({printable(error)})") from None
    found: dict[str, Capture] = {}
    for number, row in enumerate(rows, start=2):
        where = f"{printable(path)}, line {number}"
        name, photos = (row.get("capture") or "").strip(), (row.get("photos") or "").strip()
        if not NAME.fullmatch(name):
            raise InputError(
                f"{where}: a capture called {printable(name)!r}. Expected up to 100 letters, digits"
                ", dots, dashes or underscores, the first a letter or digit"
            )
        if not photos:
            raise InputError(f"{where}: no photos. Expected columns {', '.join(COLUMNS)}")
        if name in found:
            raise InputError(f"{where}: a second capture called {name}. Rename one of them")
        try:
            assignments = tuple(shlex.split(row.get("set") or ""))
        except ValueError as error:
            raise InputError(f"{where}: set is not readable ({error})") from None
        chosen = (row.get("recipe") or "").strip() or recipe.DEFAULT
        found[name] = Capture(name, root / photos, chosen, assignments)
    return tuple(found.values())


def _table_text(captures: Sequence[Capture]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, delimiter="\t", lineterminator="\n")
    writer.writerow(COLUMNS)
    for capture in captures:
        if printable(capture.photos) != str(capture.photos):
            raise InputError(
                f"{printable(capture.photos)}: a path with control characters, or not UTF-8. "
                "Rename the folder"
            )
        sets = shlex.join(capture.assignments)
        writer.writerow([capture.name, capture.photos, capture.recipe, sets])
    return text.getvalue()
