"""A workspace as the command line sees it: what it was made from, and how it stands."""

import json
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from refdgs_pipe import recipe
from refdgs_pipe.cli import mask_model
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.files.kinds import sniff
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline import catalog
from refdgs_pipe.pipeline.atomic import disk_errors, write_json
from refdgs_pipe.pipeline.fingerprint import Fingerprint
from refdgs_pipe.pipeline.plan import Pipeline, Step
from refdgs_pipe.pipeline.stage import Source
from refdgs_pipe.pipeline.store import Store

MEMORY = "workspace.json"


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
            InputError: the folder is not a workspace.
        """
        try:
            record = json.loads((root / MEMORY).read_text("utf-8"))
            photos = tuple(_find(entry, root) for entry in record["photos"])
            name = record["recipe"]
            name = name if isinstance(name, str) else str(_find(name, root))
            return cls(photos, name, tuple(record["set"]))
        except (OSError, ValueError, KeyError, TypeError):
            raise InputError(
                f"{root}: not a workspace. Give the folder that `run` made, such as PHOTOS.refdgs"
            ) from None

    def write(self, root: Path) -> None:
        """Remember in the workspace. Paths are kept relative too, so that both may move together.

        Raises:
            WriteError: the workspace cannot be written.
        """
        is_file = self.recipe.endswith(".toml")
        record = {
            "photos": [_note(path, root) for path in self.photos],
            "recipe": _note(Path(self.recipe), root) if is_file else self.recipe,
            "set": list(self.assignments),
        }
        with disk_errors(root):
            if not (root / MEMORY).exists() or self != Memory.read(root):
                write_json(root / MEMORY, record)


@dataclass(frozen=True)
class Workspace:
    """A workspace with its source and settings, ready to be looked at or run."""

    root: Path
    memory: Memory
    pipeline: Pipeline
    source: Source
    settings: dict[str, Params]

    def fingerprint(self) -> Fingerprint:
        """The photos as they are; as they were when the last run read them, if they are gone.

        Raises:
            CaptureError: they are gone and were never read.
        """
        try:
            return self.pipeline.fingerprint(self.source)
        except (CaptureError, InputError, OSError):
            if last := self.pipeline.last_fingerprint():
                return last
            raise

    def status(self) -> list[Step]:
        """How every stage stands."""
        return self.pipeline.status(self.fingerprint(), self.settings)

    def result(self, name: str) -> tuple[Step, Path]:
        """A stage, given by its name or by what it makes, and the folder of its current result.

        Raises:
            InputError: there is no such stage, or its result is missing.
        """
        name = self.stage_name(name)
        step = next(step for step in self.status() if step.stage.name == name)
        if step.origin is None or step.manifest is None:
            raise InputError(f"{name} has no current result: {step.reason}. Make it with `run`")
        return step, self.pipeline.store.folder(step.origin)

    def stage_name(self, text: str) -> str:
        """The name of a stage, given by it or by what it makes ("mesh" for clean)."""
        for stage in self.pipeline.stages:
            if text.lower() == stage.output.__name__.lower():
                return stage.name
        return self.pipeline.stage(text).name


def default_root(photos: Sequence[Path]) -> Path:
    """Where the workspace goes if nothing was said: PHOTOS.refdgs beside the photos."""
    first = absolute(photos[0])
    if len(photos) == 1 and first.is_file() and sniff(first) in ("zip", "video"):
        return first.with_suffix(".refdgs")
    if len(photos) > 1 or first.is_file():
        first = first.parent
    return first.with_name(f"{first.name}.refdgs")


def is_workspace(path: Path) -> bool:
    """Whether a folder was made by `run`."""
    return (path / MEMORY).is_file()


def note(text: str) -> None:
    """Tell the user something that ends no run."""
    print(f"note: {text}", file=sys.stderr)


def open_workspace(
    root: Path, memory: Memory | None = None, *, tell: Callable[[str], None] = note
) -> Workspace:
    """Open a workspace with the given source and settings, or with those it remembers.

    Args:
        tell: hears of remembered settings that are none any more.

    Raises:
        InputError: it is not a workspace, or the settings are wrong.
    """
    root = absolute(root)
    memory = memory or Memory.read(root)
    pipeline = catalog.build(Store(root))
    models = {stage.name: stage.params for stage in pipeline.stages}
    found = recipe.load(memory.recipe)
    settings = recipe.resolve(found, memory.assignments, models, tell=tell)
    settings = _with_recipe_name(settings, memory.recipe)
    settings = mask_model.with_digest(settings, pipeline.store)
    memory = replace(memory, assignments=recipe.without_former(memory.assignments, models))
    make: Any = pipeline.source
    return Workspace(root, memory, pipeline, make(paths=memory.photos), settings)


def open_for_run(
    photos: Sequence[Path],
    root: Path | None,
    recipe_name: str | None,
    assignments: Sequence[str],
    *,
    tell: Callable[[str], None] = note,
) -> Workspace:
    """The workspace of the given photos; or the given workspace, with what it remembers.

    Args:
        root: where the workspace is or will be; None: see `default_root`.

    Raises:
        InputError: the settings are wrong.
        CaptureError: there are no photos.
    """
    if root is None and len(photos) == 1 and is_workspace(photos[0]):
        return open_workspace(photos[0], remembered(photos[0], recipe_name, assignments), tell=tell)
    name = absolute_recipe(recipe_name or recipe.DEFAULT)
    memory = Memory(tuple(absolute(path) for path in photos), name, tuple(assignments))
    space = open_workspace(root or default_root(photos), memory, tell=tell)
    space.source.files()  # a missing or empty folder is said before a workspace is made
    return space


def _with_recipe_name(settings: dict[str, Params], name: str) -> dict[str, Params]:
    """The exported files name the recipe that they were made by, unless told another name."""
    params = settings.get("export")
    if params is None or getattr(params, "recipe", None) != "":
        return settings
    return settings | {"export": params.model_copy(update={"recipe": Path(name).stem})}


def remembered(root: Path, name: str | None, assignments: Sequence[str]) -> Memory:
    """What a workspace remembers, with another recipe or more settings.

    Raises:
        InputError: the folder is not a workspace.
    """
    memory = Memory.read(root)
    if name is not None:
        return Memory(memory.photos, absolute_recipe(name), tuple(assignments))
    return Memory(memory.photos, memory.recipe, (*memory.assignments, *assignments))


def absolute_recipe(name: str) -> str:
    """A recipe's name, or the absolute path of a recipe file."""
    return str(absolute(Path(name))) if name.endswith(".toml") else name


def absolute(path: Path) -> Path:
    """The path from the root of the file system; links in it stay what they are."""
    return Path(os.path.normpath(Path.cwd() / path))


def weight(path: Path) -> int:
    """The bytes of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files)


def _note(path: Path, root: Path) -> list[str]:
    return [os.path.relpath(path, root), str(path)]


def _find(entry: Sequence[str], root: Path) -> Path:
    """The place of a noted path: beside the workspace as it was, else where it was."""
    relative = absolute(root / entry[0])
    with suppress(OSError):
        if relative.exists():
            return relative
    return Path(entry[1])
