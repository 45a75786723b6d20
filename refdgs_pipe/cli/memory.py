"""What a workspace remembers of its last run: photos, recipe and settings. docs/workspace.md."""

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from refdgs_pipe import recipe
from refdgs_pipe.documents import parse_json, read_text
from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.formatting import printable
from refdgs_pipe.names import fault_of
from refdgs_pipe.pipeline.atomic import disk_errors, write_json, write_text

MEMORY = "workspace.json"
FORMAT = 1  # of a workspace; raised when an older program could not read one
RECIPES = "recipe"  # the folder with a copy of the user's own recipe
_LIMIT = 16_000_000  # bytes


@dataclass(frozen=True)
class Memory:
    """What a workspace was last run with.

    Args:
        photos: absolute paths.
        recipe: a name, or the absolute path of a TOML file.
        assignments: the `stage.key=value` given by `--set`.
    """

    photos: tuple[Path, ...]
    recipe: str
    assignments: tuple[str, ...]

    @classmethod
    def read(cls, root: Path) -> Self:
        """Read what a workspace remembers.

        Raises:
            InputError: the folder is not a workspace, or one of a newer program.
            CorruptError: its note is damaged.
        """
        path = root / MEMORY
        try:
            record = parse_json(read_text(path, limit=_LIMIT, follow=False))
            version = record.get("format", 1)
            if isinstance(version, int) and version > FORMAT:
                raise InputError(
                    f"{printable(root)}: a newer refdgs-pipe made this workspace (format {version},"
                    f" this one reads up to {FORMAT}). Update refdgs-pipe"
                )
            photos = tuple(_find(entry, root) for entry in record["photos"])
            name = record["recipe"]
            name = name if isinstance(name, str) else str(_find_recipe(name, root))
            sets = tuple(record["set"])
            if version != 1 or not photos or not all(isinstance(text, str) for text in sets):
                raise ValueError("it says what cannot be meant")
            return cls(photos, name, sets)
        except (FileNotFoundError, NotADirectoryError):
            raise InputError(
                f"{printable(root)}: not a workspace. Give the folder that `run` made, such as "
                "PHOTOS.refdgs"
            ) from None
        except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
            raise CorruptError(
                f"{printable(path)}: damaged ({printable(error)}). Name the photos again: "
                f"refdgs-pipe run PHOTOS -w {printable(root)}. What is finished is kept"
            ) from None

    def write(self, root: Path) -> None:
        """Remember in the workspace. Paths are kept relative too, so that both may move together.

        A recipe of the user's is copied into the workspace, with all that it builds on.

        Raises:
            WriteError: the workspace cannot be written.
        """
        own = Path(self.recipe) if self.recipe.endswith(".toml") else None
        record = {
            "format": FORMAT,
            "photos": [_note(path, root) for path in self.photos],
            "recipe": self.recipe if own is None else _note(own, root),
            "set": list(self.assignments),
        }
        with disk_errors(root):
            if own is not None and own.parent != root / RECIPES:
                _keep(own, root)
            with suppress(InputError, CorruptError):
                if Memory.read(root) == self:
                    return
            write_json(root / MEMORY, record)


def is_workspace(path: Path) -> bool:
    """Whether a folder was made by `run`."""
    return (path / MEMORY).is_file()


def remembered(root: Path, name: str | None, assignments: Sequence[str]) -> Memory:
    """What a workspace remembers, with another recipe or more settings.

    Raises:
        InputError: the folder is not a workspace.
        CorruptError: its note is damaged.
    """
    return changed(Memory.read(root), name, assignments)


def changed(memory: Memory, name: str | None, assignments: Sequence[str]) -> Memory:
    """A memory with another recipe, which forgets the settings; or with more settings."""
    if name is not None:
        return Memory(memory.photos, absolute_recipe(name), tuple(assignments))
    return Memory(memory.photos, memory.recipe, _latest([*memory.assignments, *assignments]))


def absolute_recipe(name: str) -> str:
    """A recipe's name, or the absolute path of a recipe file."""
    return str(absolute(Path(name))) if name.endswith(".toml") else name


def absolute(path: Path) -> Path:
    """The path from the root of the file system; links in it stay what they are."""
    return Path(os.path.normpath(Path.cwd() / path))


def _latest(assignments: Iterable[str]) -> tuple[str, ...]:
    """The assignments without those that a later one of the same setting undoes."""
    last: dict[str, str] = {}
    for text in assignments:
        key = text.partition("=")[0].strip()
        last.pop(key, None)
        last[key] = text
    return tuple(last.values())


def _note(path: Path, root: Path) -> list[str]:
    return [os.path.relpath(path, root), str(path)]


def _find(entry: Any, root: Path) -> Path:
    """The place of a noted path: beside the workspace as it was, else where it was.

    Raises:
        ValueError: it is no such note.
    """
    near, far = entry
    if not all(isinstance(text, str) and text and "\0" not in text for text in (near, far)):
        raise ValueError("a path is none")
    relative = absolute(root / near)
    with suppress(OSError):
        if relative.exists():
            return relative
    return Path(far)


def _find_recipe(entry: Any, root: Path) -> Path:
    """A noted recipe; its copy in the workspace if it is not where it was."""
    path = _find(entry, root)
    copy = root / RECIPES / path.name
    with suppress(OSError):
        if not path.exists() and not fault_of(path.name) and copy.is_file():
            return copy
    return path


def _keep(file: Path, root: Path) -> None:
    """Copy a recipe, with all that it builds on, into the workspace."""
    folder = root / RECIPES
    text = recipe.as_toml(recipe.load(str(file)))
    if folder.is_symlink():
        raise InputError(f"{folder}: is a link. A workspace holds no links: delete it")
    folder.mkdir(parents=True, exist_ok=True)
    with suppress(OSError, ValueError):
        if read_text(folder / file.name, follow=False) == text:
            return
    write_text(folder / file.name, text)
