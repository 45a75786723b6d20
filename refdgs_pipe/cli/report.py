"""The report of a workspace: made on demand, and at the end of every run."""

import sys
from pathlib import Path

from refdgs_pipe import recipe
from refdgs_pipe.cli.device import core_count
from refdgs_pipe.cli.verdict import is_draft
from refdgs_pipe.cli.workspace import Workspace


def write(space: Workspace, out: Path | None, *, threads: int) -> Path:
    """Write report.html in the workspace, or to `out`, and return where it is.

    What cannot be shown is said on stderr and on the page.

    Raises:
        WriteError: the page cannot be written.
        InputError, CaptureError: as `status` raises them.
    """
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
        print(f"report: warning: {problem}", file=sys.stderr)
    return path


def write_if_possible(space: Workspace, *, threads: int) -> Path | None:
    """`write`, but whatever goes wrong is only a warning: the run itself is over."""
    try:
        return write(space, None, threads=threads)
    except KeyboardInterrupt:
        print("report: warning: not written, stopped", file=sys.stderr)
        return None
    except Exception as error:
        kind = type(error).__name__
        print(f"report: warning: not written, {kind}: {error}", file=sys.stderr)
        return None


def _folders(space: Workspace) -> list[Path]:
    """Where the photos are, and the recipe if it is a file."""
    recipe_file = Path(space.memory.recipe)
    named = [recipe_file.parent] if space.memory.recipe not in recipe.names() else []
    return [*(photo.parent for photo in space.memory.photos), *named]
