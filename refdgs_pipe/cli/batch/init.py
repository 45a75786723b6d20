"""`batch init`: a table of captures, a Snakefile and profiles, for a person to edit."""

import shlex
import sys
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from refdgs_pipe.cli.batch.table import NOTE, Batch, Capture, named
from refdgs_pipe.cli.workspace import absolute, absolute_recipe, is_workspace
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline.atomic import disk_errors, write_text
from refdgs_pipe.pipeline.store import Store
from refdgs_pipe.sharing.places import check_place, look_at

PROFILES = ("local", "slurm", "kubernetes")
SNAKEFILE = "Snakefile"
_COMMAND = 'COMMAND = "refdgs-pipe"'


def init(
    paths: Sequence[Path],
    root: Path,
    *,
    recipe_name: str,
    assignments: Sequence[str],
    cache: str | None = None,
) -> tuple[Batch, int]:
    """Make a batch, or add captures to one. Files that are there and may be edited stay.

    Returns:
        The batch, and how many captures are new in it.

    Raises:
        InputError: the settings are wrong, or a path cannot be meant.
        CaptureError: a capture is not there.
        WorkspaceBusy: the batch is running.
        WriteError: the folder cannot be written.
    """
    root = absolute(root)
    cache = None if cache is None else check_place(cache)
    captures = [absolute(path) for path in dict.fromkeys(paths)]
    for path in captures:
        if not path.exists():
            raise CaptureError(f"{printable(path)}: no such file or folder")
        if is_workspace(path):
            raise InputError(f"{printable(path)}: a workspace. Give the photos that it is of")
        if root == path or root.is_relative_to(path):
            raise InputError(f"--out {printable(root)}: inside the capture {printable(path)}")
    there = Batch.read(root) if (root / NOTE).exists() else Batch(root, ())
    known = {capture.photos for capture in there.captures}
    new = [path for path in captures if path not in known]
    names = named(new, [capture.name for capture in there.captures])
    recipe, sets = absolute_recipe(recipe_name), tuple(assignments)
    added = tuple(Capture(name, path, recipe, sets) for name, path in names)
    if cache is not None:
        look_at(cache)
    batch = Batch(root, (*there.captures, *added), cache or there.cache)
    if added:
        batch.open(added[0])  # a wrong setting is said now, and not by every job
    with Store(root).lock():
        batch.write()
        _write_missing(root)
    return batch, len(added)


def _write_missing(root: Path) -> None:
    """Write the Snakefile and the profiles, each unless it is there."""
    source = files("refdgs_pipe.cli.batch")
    command = f"COMMAND = {shlex.join([sys.executable, '-m', 'refdgs_pipe'])!r}"
    texts = {root / SNAKEFILE: source.joinpath(SNAKEFILE).read_text("utf-8")}
    texts[root / SNAKEFILE] = texts[root / SNAKEFILE].replace(_COMMAND, command)
    for name in PROFILES:
        text = source.joinpath("profiles", f"{name}.yaml").read_text("utf-8")
        texts[profile_path(root, name)] = text.replace("BATCH_FOLDER", str(root))
    with disk_errors(root):
        for path, text in texts.items():
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                write_text(path, text)


def profile_path(root: Path, name: str) -> Path:
    """Where a profile of a batch is."""
    return root / "profiles" / name / "config.yaml"
