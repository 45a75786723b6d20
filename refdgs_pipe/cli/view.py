"""The command `view`: a page that shows a workspace while it is made, on this machine only."""

import os
import shlex
import signal
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer

from refdgs_pipe.cli.device import core_count
from refdgs_pipe.cli.memory import Memory, absolute, remembered
from refdgs_pipe.cli.options import Folder
from refdgs_pipe.cli.workspace import open_workspace
from refdgs_pipe.errors import RefdgsError, WorkspaceBusy
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline.catalog import STAGES
from refdgs_pipe.pipeline.store import Store
from refdgs_pipe.stage_words import doing

NICENESS = 10  # a tenth of the share of an ordinary process; `Effort` bounds the sum


def view_command(
    workspace: Folder,
    port: Annotated[
        int,
        typer.Option(
            "--port", min=0, max=65535, help="port of the page; 0: the first free one from 8080"
        ),
    ] = 0,
    with_run: Annotated[int, typer.Option("--with-run", hidden=True, help="its threads")] = 0,
) -> None:
    """Show a workspace in a browser, also during a run. Ctrl-C ends the view."""
    from refdgs_pipe.viewing.server import check_installed, free_port

    root = absolute(workspace)
    if not with_run:  # a run may only be about to make it
        Memory.read(root)
    check_installed()
    port = free_port(port)
    stop = _stop_signal()
    _be_modest()
    parent = os.getppid() if with_run else None
    serve(root, port, stop, cores=with_run or core_count(), parent=parent)


def serve(
    root: Path, port: int, stop: threading.Event, *, cores: int, parent: int | None = None
) -> None:
    """Show a workspace until `stop` is set.

    Args:
        cores: that a run in the workspace may use.
        parent: end too once this process is not our parent any more.
    """
    from refdgs_pipe.viewing.effort import Effort
    from refdgs_pipe.viewing.page import Page
    from refdgs_pipe.viewing.server import address, open_server, quiet
    from refdgs_pipe.viewing.watching import Watch

    server = open_server(port, printable(root.name))
    print(f"view: {address(port)}", file=sys.stderr, flush=True)
    try:
        page = Page(
            server,
            Watch(root, STAGES),
            Effort(cores),
            stages={name: doing(name) for name in STAGES},
            run=f"refdgs-pipe run {shlex.quote(printable(root))}",
            remember=lambda assignments: remember(root, assignments),
        )
        while not stop.wait(page.step()):
            if parent is not None and os.getppid() != parent:
                break
    finally:
        with quiet():
            server.stop()


def remember(root: Path, assignments: list[str]) -> str:
    """Let a workspace remember settings for its next run. Return what came of it, in a sentence.

    They stand in workspace.json, as those of `--set` do. Nothing is written while a run goes on.
    """
    try:
        memory = remembered(root, None, assignments)
        open_workspace(root, memory, tell=lambda _: None)  # refuses what cannot be meant
        with Store(root).lock():
            memory.write(root)
    except WorkspaceBusy:
        return "A run goes on here. Stop it first, or give these settings to the next run."
    except RefdgsError as error:
        return f"Not remembered: {error}"
    return f"Remembered. `refdgs-pipe run {printable(root)}` makes what this changes."


def _stop_signal() -> threading.Event:
    """Set by Ctrl-C and SIGTERM, which both end a view as it is meant to end."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def _be_modest() -> None:
    """Low priority, one thread; before a library that has threads is loaded."""
    os.nice(NICENESS)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    import cv2

    cv2.setNumThreads(1)
