"""The report of a workspace: made on demand, and at the end of every run."""

import sys
from pathlib import Path

from refdgs_pipe import recipe
from refdgs_pipe.cli.device import core_count
from refdgs_pipe.cli.verdict import is_draft
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.errors import InputError
from refdgs_pipe.formatting import printable
from refdgs_pipe.trouble import explained


def write(space: Workspace, out: Path | None, *, threads: int) -> Path:
    """Write report.html in the workspace, or to `out`, and return where it is.

    What cannot be shown is said on stderr and on the page.

    Raises:
        WriteError: the page cannot be written.
        InputError: `out` is a folder, or in none; else, and CaptureError, as `status` raises them.
    """
    if out is not None and out.is_dir():
        raise InputError(f"--out {printable(out)}: a folder. Give a file, such as {out / 'a.html'}")
    if out is not None and not out.absolute().parent.is_dir():
        raise InputError(f"--out {printable(out)}: there is no such folder. Make it first")
    from refdgs_pipe.reporting.facts import Drawing, collect
    from refdgs_pipe.reporting.page import NAME, write_report

    facts = collect(
        space.pipeline.store,
        space.status(),
        about={
            "recipe": Path(space.memory.recipe).name,
            "draft": is_draft(space),
            "changed": space.memory.assignments,
            "settings": {n: p.model_dump(mode="json") for n, p in space.settings.items()},
        },
        private=[space.root, space.root.parent, Path.home(), *_folders(space)],
    )
    path = out or space.root / NAME
    for problem in write_report(path, facts, Drawing(threads or core_count())):
        print(f"report: warning: {printable(problem)}", file=sys.stderr)
    return path


def write_if_possible(space: Workspace, *, threads: int) -> Path | None:
    """`write`, but whatever goes wrong is only a warning: the run itself is over."""
    try:
        return write(space, None, threads=threads)
    except KeyboardInterrupt:
        print("report: warning: not written, stopped", file=sys.stderr)
        return None
    except Exception as error:
        words = printable(explained(error) or f"{type(error).__name__}: {error}")
        print(f"report: warning: not written, {words}", file=sys.stderr)
        return None


def _folders(space: Workspace) -> list[Path]:
    """Where the photos are, and the recipe if it is a file."""
    recipe_file = Path(space.memory.recipe)
    named = [recipe_file.parent] if space.memory.recipe not in recipe.names() else []
    return [*(photo.parent for photo in space.memory.photos), *named]
