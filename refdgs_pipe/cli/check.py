"""The command `check`: look at photos before anyone waits for hours."""

import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from refdgs_pipe import recipe
from refdgs_pipe.cli.console import Console
from refdgs_pipe.cli.device import core_count
from refdgs_pipe.cli.signals import Stopper
from refdgs_pipe.cli.workspace import Memory, absolute, default_root, is_workspace
from refdgs_pipe.documents import write_json_text
from refdgs_pipe.errors import Cancelled, InputError, WriteError
from refdgs_pipe.formatting import about_room, aligned, roughly
from refdgs_pipe.pipeline.catalog import load_stages
from refdgs_pipe.pipeline.events import Progress, Started

if TYPE_CHECKING:
    from refdgs_pipe.checking.record import Checked
    from refdgs_pipe.params import Params

_MARKS = {"ok": "ok", "note": "note", "but": "but", "bad": "NO"}


def check_command(
    photos: Annotated[
        list[Path],
        typer.Argument(help="a folder or ZIP of photos, photos, a video, or a workspace"),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", help="file for the page [PHOTOS.check.html]", metavar="FILE"),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="print one JSON object on stdout")
    ] = False,
    threads: Annotated[
        int, typer.Option("--threads", min=0, help="CPU threads; 0: every core")
    ] = 0,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="show no progress")] = False,
) -> None:
    """Check in about a minute if photos can be used. Say what is wrong and how long a run takes."""
    if len(photos) == 1 and is_workspace(photos[0]):
        photos = list(Memory.read(photos[0]).photos)
    paths = tuple(absolute(path) for path in photos)
    title = default_root(paths).name.removesuffix(".refdgs")
    page = _page(paths, out, title)
    with Stopper() as stopper, tempfile.TemporaryDirectory(prefix="refdgs-pipe-") as folder:
        try:
            checked = check(
                paths, Path(folder), threads=threads or core_count(), quiet=quiet, stopper=stopper
            )
        except Cancelled as error:
            raise type(stopper.error(error))(str(error)) from None
        written = _write(page, title, checked, is_asked=out is not None)
    if as_json:
        from refdgs_pipe.checking.record import record

        told = record(checked) | {"page": written and str(written)}
        print(write_json_text(told, indent=2))
    else:
        print(describe(checked))
        if written is not None:
            print(f"page: {written}")
    raise typer.Exit(checked.verdict.exit_code)


def check(
    paths: tuple[Path, ...], scratch: Path, *, threads: int, quiet: bool, stopper: Stopper
) -> "Checked":
    """Look at photos and judge what was found; the pictures lie below `scratch`.

    Raises:
        InputError, CaptureError: the paths do not exist, or hold no photos.
        Cancelled: stopped by a signal.
    """
    from refdgs_pipe.checking.cost import cost
    from refdgs_pipe.checking.findings import findings_of, judge
    from refdgs_pipe.checking.look import take_look
    from refdgs_pipe.checking.record import Checked

    start = time.monotonic()
    settings = {name: _settings(name) for name in recipe.names()}
    least = float(getattr(settings[recipe.DEFAULT]["gate"], "min_trusted", 0.0))
    console = Console(verbosity=0 if quiet else 1)

    def progress(label: str, done: int, total: int | None) -> None:
        console(Progress("check", label, done, total))

    with console:
        console(Started("check", "never run"))
        look = take_look(
            paths, scratch, least=least, threads=threads, progress=progress, stop=stopper.stop
        )
    found = findings_of(look)
    costs = tuple(
        cost(look, name, recipe.load(name).about, chosen, cores=threads)
        for name, chosen in settings.items()
        if look.views is not None
    )
    return Checked(look, found, judge(look, found), costs, threads, time.monotonic() - start)


def describe(checked: "Checked") -> str:
    """The check in words: the verdict, what to do, what was found, what a run takes."""
    verdict = checked.verdict
    lines = [verdict.line, *(f"  - {text}" for text in verdict.to_do), ""]
    lines += aligned([(_MARKS[f.state], f.name, f.text) for f in checked.findings])
    if checked.costs:
        lines += ["", f"a run takes, with {checked.cores} of this machine's cores:"]
    rows = [(c.recipe, roughly(c.seconds), f"{about_room(c.bytes)} on disk") for c in checked.costs]
    lines += aligned(rows, before="  ")
    return "\n".join([*lines, ""])


def _settings(name: str) -> "dict[str, Params]":
    models = {stage.name: stage.params for stage in load_stages()}
    return recipe.resolve(recipe.load(name), [], models)


def _page(paths: tuple[Path, ...], out: Path | None, title: str) -> Path:
    """Where the page goes: never among the photos.

    Raises:
        InputError: `out` lies in the folder of photos.
    """
    folders = [path for path in paths if path.is_dir()]
    folders += [path.parent for path in paths[1:]]
    if out is None:
        return default_root(paths).with_name(f"{title}.check.html")
    page = absolute(out)
    if any(folder == page.parent or folder in page.parents for folder in folders):
        raise InputError(f"--out {out}: lies among the photos. Give a file elsewhere")
    return page


def _write(page: Path, title: str, checked: "Checked", *, is_asked: bool) -> Path | None:
    """Write the page; where nobody asked for the place, being unable to is only a warning."""
    from refdgs_pipe.reporting.check import write_check

    try:
        write_check(page, title, checked)
    except WriteError as error:
        if is_asked:
            raise
        print(f"check: warning: no page: {error}. Give --out", file=sys.stderr)
        return None
    return page
