"""`batch report`: the page of a batch."""

import os
from pathlib import Path

from refdgs_pipe.cli.batch.standing import Standing, standings
from refdgs_pipe.cli.batch.table import Batch
from refdgs_pipe.cli.workspace import absolute
from refdgs_pipe.errors import InputError
from refdgs_pipe.formatting import printable
from refdgs_pipe.reporting.catalogue import Entry, write_catalogue

NAME = "report.html"
PREVIEW = "preview.png"  # of an asset


def write(batch: Batch, out: Path | None) -> Path:
    """Write report.html in the batch, or to `out`, and return where it is.

    Raises:
        InputError: `out` is a folder, or in none.
        WriteError: the page cannot be written.
    """
    path = absolute(out) if out else batch.root / NAME
    if path.is_dir() or not path.parent.is_dir():
        raise InputError(f"--out {printable(path)}: expected a file in a folder that is there")
    found = standings(batch)
    write_catalogue(path, batch.root.name, [_entry(batch, one, path.parent) for one in found])
    return path


def _entry(batch: Batch, one: Standing, folder: Path) -> Entry:
    picture = f"{one.asset}/{PREVIEW}" if one.asset else None
    if picture and not (batch.root / picture).is_file():
        picture = None
    code = f" (exit code {one.exit_code})" if one.exit_code else ""
    return Entry(
        one.capture,
        one.state,
        one.verdict,
        one.score,
        sum(one.seconds.values()),
        one.attempts,
        one.warnings,
        f"{one.part}: {one.reason}{code}" if one.reason else "",
        _from(batch, one.report, folder),
        _from(batch, picture, folder),
    )


def _from(batch: Batch, path: str | None, folder: Path) -> str | None:
    """A path of the batch as the page's folder sees it."""
    return None if path is None else os.path.relpath(batch.root / path, folder)
