"""How the stages of a workspace stand, in words and as JSON."""

from typing import Any

from refdgs_pipe.cli import workspace as spaces
from refdgs_pipe.cli.activity import Activity, activity
from refdgs_pipe.cli.options import Assignments, Folder, Json, RecipeName
from refdgs_pipe.cli.running import steps_json
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.documents import write_json_text
from refdgs_pipe.formatting import aligned, duration, merged, printable
from refdgs_pipe.pipeline.plan import Step


def status_command(
    workspace: Folder,
    recipe_name: RecipeName = None,
    assignments: Assignments = None,
    as_json: Json = False,
) -> None:
    """Say whether each stage is up to date, and if not, why. Say what is running."""
    memory = spaces.remembered(workspace, recipe_name, assignments or [])
    space = spaces.open_workspace(workspace, memory)
    steps, now = space.status(), activity(space.root)
    if as_json:
        print(write_json_text(record(space, steps, now), indent=2))
        return
    if now is not None:
        print(printable(now.words))
    for line in describe(steps, now):
        print(printable(line))


def record(space: Workspace, steps: list[Step], now: Activity | None) -> dict[str, Any]:
    """As JSON has it."""
    return {
        "workspace": str(space.root),
        "photos": [str(path) for path in space.memory.photos],
        "recipe": space.memory.recipe,
        "set": list(space.memory.assignments),
        "running": now and now.record(),
        "stages": steps_json(steps, space),
    }


def describe(steps: list[Step], now: Activity | None) -> list[str]:
    """A line for each stage, and one for each of its warnings."""
    running = now.stage if now is not None else None
    rows = [_row(step, is_running=step.stage.name == running) for step in steps]
    indent = " " * (max(len(row[0]) for row in rows) + 2)
    lines = []
    for line, step in zip(aligned(rows), steps, strict=True):
        lines.append(line)
        for warning in merged(step.manifest.warnings) if step.manifest else ():
            lines.append(f"{indent}warning: {warning}")
    return lines


def _row(step: Step, *, is_running: bool) -> tuple[str, ...]:
    """Its name, how it stands, how long it took, and the reason."""
    if is_running:
        return step.stage.name, "running"
    made = step.manifest if step.state != "adopted" else None
    took = duration(made.seconds) if made else ""
    reason = step.reason.removeprefix(step.state).lstrip(": ")
    return step.stage.name, step.state, took, reason
