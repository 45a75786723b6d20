"""The commands of `cache`: keep shared results sound and small."""

import re
import sys
from datetime import timedelta
from pathlib import Path
from typing import Annotated

import typer

from refdgs_pipe.cli.options import DryRun
from refdgs_pipe.documents import read_text
from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.formatting import counted, printable, size
from refdgs_pipe.pipeline.catalog import STAGES
from refdgs_pipe.pipeline.leftovers import results_in

caches = typer.Typer(
    help="Check shared results, and delete old ones.",
    no_args_is_help=True,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
Place = Annotated[
    str,
    typer.Argument(help="s3://, gs://, az:// or a folder", metavar="CACHE"),
]
_UNITS = {"h": 1, "d": 24, "w": 168}  # hours
_LINE = re.compile(r"[a-z]+/[0-9a-f]{16}")


@caches.command("verify")
def verify_command(
    place: Place,
    delete: Annotated[bool, typer.Option("--delete", help="delete what is damaged")] = False,
) -> None:
    """Download all shared files and compare them with their hashes. Damaged ones are named."""
    from refdgs_pipe.sharing.places import look_at
    from refdgs_pipe.sharing.upkeep import described, verify

    found = verify(look_at(place), delete=delete)
    for line in described(found):
        print(line)
    counts = f"{counted(found.records, 'result')}, {counted(found.files, 'file')}"
    print(f"{counts}, {size(found.bytes)}: {len(found.bad)} damaged", file=sys.stderr)
    raise typer.Exit(CorruptError.exit_code if found.bad else 0)


@caches.command("gc")
def gc_command(
    place: Place,
    older_than: Annotated[
        str,
        typer.Option(
            "--older-than", help="least age of deleted results: 12h, 30d, 4w", metavar="30d"
        ),
    ] = "30d",
    keep: Annotated[
        Path | None,
        typer.Option(
            "--keep",
            help="list of what stays: a STAGE/KEY, workspace or batch per line",
            metavar="FILE",
        ),
    ] = None,
    dry_run: DryRun = False,
) -> None:
    """Delete old shared results, and files that no result needs."""
    from refdgs_pipe.sharing.places import look_at
    from refdgs_pipe.sharing.upkeep import collect

    age, kept = age_of(older_than), kept_by(keep) if keep else set()
    found = collect(look_at(place), age, kept.__contains__, dry_run=dry_run)
    word = "would delete" if dry_run else "deleted"
    counts = f"{counted(found.records, 'result')} and {counted(found.files, 'file')}"
    print(f"{word} {counts}, {size(found.bytes)}", file=sys.stderr)


def age_of(text: str) -> timedelta:
    """An age such as 12h, 30d or 4w.

    Raises:
        InputError: it is none.
    """
    found = re.fullmatch(r"(\d{1,6})([hdw])", text.strip())
    if not found:
        raise InputError(f"--older-than {text}: expected an age such as 12h, 30d or 4w")
    return timedelta(hours=int(found[1]) * _UNITS[found[2]])


def kept_by(file: Path) -> set[str]:
    """The STAGE/KEY that a file names, one a line, or by workspaces and batches that have them.

    Raises:
        InputError: it cannot be read, or a line says neither.
    """
    try:
        lines = [line.strip() for line in read_text(file).splitlines()]
    except (OSError, ValueError) as error:
        raise InputError(f"--keep {printable(file)}: cannot be read ({printable(error)})") from None
    kept: set[str] = set()
    for number, line in enumerate(lines, start=1):
        folder = file.parent / line
        if not line or line.startswith("#"):
            continue
        if _LINE.fullmatch(line):
            kept.add(line)
        elif folder.is_dir():
            for root in (folder, *folder.glob("workspaces/*.refdgs")):
                kept |= {f"{p.parent.name}/{p.name}" for p in results_in(root, STAGES)}
        else:
            raise InputError(
                f"--keep {printable(file)}, line {number}: neither STAGE/KEY nor a folder"
            )
    return kept
