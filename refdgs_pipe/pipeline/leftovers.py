"""What in a workspace is ours: results, and what killed runs left. Nothing else is ever deleted."""

import os
import re
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from refdgs_pipe.pipeline.atomic import remove, rescue
from refdgs_pipe.pipeline.manifest import KEY

PUBLISHED = {"export": "asset"}  # stage -> the folder of the workspace that shows its result
_OLD = re.compile(r"\.old-([0-9a-f]{16})")
_KEPT = re.compile(r"(?:\.(?:trash-)*(?:partial-|scratch-|damaged-|old-)?)?[0-9a-f]{16}")
# what `write_text` writes to before it renames, of the notes that we keep
_NOTE = re.compile(
    r"\.(?:workspace\.json|recipe\.toml|report\.html|\.source\.json|\.published|\.current"
    r"|\.adopted|\.lock-owner|\.mask-model\.json)-(\d+)"
)
_AGE_S = 3600.0  # younger notes may belong to a process on another machine


def sweep(root: Path, stages: Iterable[str]) -> None:
    """Delete what killed runs left half-made, and bring back what they had only moved.

    Scratch stays: it is there to resume from.
    """
    for folder in _folders(root, stages):
        for name in _names(folder):
            if found := _OLD.fullmatch(name):
                rescue(folder / found[1])
            elif name.startswith((".partial-", ".trash-")) and _KEPT.fullmatch(name):
                remove(folder / name)
        _sweep_notes(folder)
    for name in PUBLISHED.values():
        rescue(root / name)
        for leftover in (f".new-{name}", *_trash_of(name)):
            remove(root / leftover)
    _sweep_notes(root)


def results_in(root: Path, stages: Iterable[str]) -> Iterator[Path]:
    """The folders of finished results, of the stages' own."""
    for folder in _folders(root, stages):
        for name in _names(folder):
            path = folder / name
            if KEY.fullmatch(name) and path.is_dir() and not path.is_symlink():
                yield path


def ours_in(root: Path, stages: Iterable[str]) -> list[Path]:
    """Every folder that the store made: results, scratch, damaged and half-made ones; sorted."""
    found = [
        folder / name
        for folder in _folders(root, stages)
        for name in _names(folder)
        if _KEPT.fullmatch(name)
    ]
    found = [path for path in found if path.is_dir() and not path.is_symlink()]
    leftovers = [root / trash for name in PUBLISHED.values() for trash in _trash_of(name)]
    return sorted([*found, *(path for path in leftovers if os.path.lexists(path))])


def _folders(root: Path, stages: Iterable[str]) -> Iterator[Path]:
    """The stages' folders that are there and are no links."""
    for stage in stages:
        folder = root / stage
        if folder.is_dir() and not folder.is_symlink():
            yield folder


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def _trash_of(name: str) -> tuple[str, ...]:
    return (f".trash-{name}", f".trash-new-{name}", f".trash-old-{name}")


def _sweep_notes(folder: Path) -> None:
    """Delete half-written notes of processes that are gone."""
    with suppress(OSError):
        for name in _names(folder):
            found = _NOTE.fullmatch(name)
            path = folder / name
            if found and not _is_alive(int(found[1])) and _age_s(path) > _AGE_S:
                path.unlink()


def _age_s(path: Path) -> float:
    return time.time() - os.lstat(path).st_mtime


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True
