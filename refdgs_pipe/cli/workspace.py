"""A workspace as the command line sees it: what it was made from, and how it stands."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from refdgs_pipe import recipe
from refdgs_pipe.cli import mask_model
from refdgs_pipe.cli.memory import (
    MEMORY,
    Memory,
    absolute,
    absolute_recipe,
    changed,
    is_workspace,
    remembered,
)
from refdgs_pipe.errors import CaptureError, CorruptError, InputError
from refdgs_pipe.files.kinds import sniff
from refdgs_pipe.formatting import printable, printable_lines
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline import catalog
from refdgs_pipe.pipeline.fingerprint import Fingerprint
from refdgs_pipe.pipeline.plan import Pipeline, Step
from refdgs_pipe.pipeline.stage import Source
from refdgs_pipe.pipeline.store import Store

__all__ = [
    "MEMORY",
    "Memory",
    "Workspace",
    "absolute",
    "absolute_recipe",
    "default_root",
    "is_workspace",
    "note",
    "open_for_run",
    "open_workspace",
    "remembered",
    "weight",
]


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
            CorruptError: a file of it is not as it was written.
        """
        name = self.stage_name(name)
        step = next(step for step in self.status() if step.stage.name == name)
        if step.origin is None or step.manifest is None:
            raise InputError(f"{name} has no current result: {step.reason}. Make it with `run`")
        try:
            return step, self.pipeline.store.check(step.manifest)
        except CorruptError as error:
            raise CorruptError(f"{error}. `refdgs-pipe verify {self.root}` mends it") from None

    def stage_name(self, text: str) -> str:
        """The name of a stage, given by it or by what it makes ("mesh" for fit)."""
        for stage in self.pipeline.stages:
            if text.lower() == stage.output.__name__.lower():
                return stage.name
        return self.pipeline.stage(text).name


def default_root(photos: Sequence[Path]) -> Path:
    """Where the workspace goes if nothing was said: PHOTOS.refdgs beside the photos.

    Raises:
        InputError: the photos are the root of the file system.
    """
    first = absolute(photos[0])
    if len(photos) == 1 and first.is_file() and sniff(first) in ("zip", "video"):
        return first.with_suffix(".refdgs")
    if len(photos) > 1 or first.is_file():
        first = first.parent
    if not first.name:
        raise InputError(f"{first}: the root of the file system. Give a folder of photos")
    return first.with_name(f"{first.name}.refdgs")


def note(text: str) -> None:
    """Tell the user something that ends no run."""
    print(f"note: {printable_lines(text)}", file=sys.stderr)


def open_workspace(
    root: Path, memory: Memory | None = None, *, tell: Callable[[str], None] = note
) -> Workspace:
    """Open a workspace with the given source and settings, or with those it remembers.

    Args:
        tell: hears of settings that have another name now, or are none any more.

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
    memory = replace(memory, assignments=recipe.up_to_date(memory.assignments, models))
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
    first = absolute(photos[0])
    if len(photos) == 1 and is_workspace(first) and (root is None or absolute(root) == first):
        return open_workspace(first, remembered(first, recipe_name, assignments), tell=tell)
    paths = tuple(absolute(path) for path in photos)
    root = absolute(root or default_root(paths))
    _refuse_places(paths, root)
    memory = _going_on(paths, root, recipe_name, assignments, tell)
    space = open_workspace(root, memory, tell=tell)
    space.source.files()  # a missing or empty folder is said before a workspace is made
    if is_workspace(root):
        _refuse_another_capture(space)
    return space


def _refuse_places(paths: Sequence[Path], root: Path) -> None:
    """Refuse photos and workspaces that cannot be meant, before anything is looked at.

    Raises:
        InputError: what is wrong.
    """
    for path in (*paths, root):
        if not path.name:
            raise InputError(f"{path}: the root of the file system. Give a folder of photos")
    if root in paths:
        raise InputError(
            f"{printable(root)}: photos and workspace are the same folder. Give another with -w"
        )
    for path in paths:
        if is_workspace(path):
            raise InputError(
                f"{printable(path)}: a workspace, not photos. Give its photos, or go on with it: "
                f"refdgs-pipe run {printable(path)}"
            )
    if root.exists() and not root.is_dir():
        raise InputError(f"{printable(root)}: a file, not a folder. Give another with -w")


def _going_on(
    paths: tuple[Path, ...],
    root: Path,
    name: str | None,
    assignments: Sequence[str],
    tell: Callable[[str], None],
) -> Memory:
    """What is asked for; what is not said is as the workspace remembers it, if there is one."""
    fresh = Memory(paths, absolute_recipe(name or recipe.DEFAULT), tuple(assignments))
    if name is not None or not is_workspace(root):
        return fresh
    try:
        memory = replace(Memory.read(root), photos=paths)
    except CorruptError:
        tell(f"{root / MEMORY} was damaged and is written anew, for recipe {fresh.recipe}")
        return fresh
    if memory.assignments or memory.recipe != recipe.DEFAULT:
        sets = "".join(f" --set {text}" for text in memory.assignments)
        tell(
            f"going on as the workspace was last run: --recipe {memory.recipe}{sets}. Give "
            "--recipe to start from one alone"
        )
    return changed(memory, None, assignments)


def _refuse_another_capture(space: Workspace) -> None:
    """Refuse to turn the workspace of other photos into one of these.

    Photos that were moved, added or taken out make no other capture: some are still the same.

    Raises:
        InputError: not one file is the same.
    """
    try:
        before = Memory.read(space.root).photos
    except CorruptError:
        return
    last = space.pipeline.last_fingerprint()
    if before == space.memory.photos or last is None:
        return
    now = space.pipeline.fingerprint(space.source).files
    if not set(now.values()) & set(last.files.values()):
        raise InputError(
            f"{printable(space.root)}: the workspace of other photos, {printable(before[0])}. "
            "Give another with -w"
        )


def _with_recipe_name(settings: dict[str, Params], name: str) -> dict[str, Params]:
    """The exported files name the recipe that they were made by, unless told another name."""
    params = settings.get("export")
    if params is None or getattr(params, "recipe", None) != "":
        return settings
    return settings | {"export": params.model_copy(update={"recipe": Path(name).stem})}


def weight(path: Path) -> int:
    """The bytes of a file, or of all files in a folder."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files)
