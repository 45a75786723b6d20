"""A grid of scenes, recipes and seeds through the pipeline, and the figures that come out.

Every cell of the grid has a workspace of its own, which is all that resuming needs.
"""

import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from refdgs_pipe.cli import workspace as spaces
from refdgs_pipe.cli.bench_table import Row, figures_of, read_rows, write_tables
from refdgs_pipe.cli.device import choose_device
from refdgs_pipe.cli.running import Options, bring_up_to
from refdgs_pipe.cli.signals import Stopper
from refdgs_pipe.cli.workspace import Memory, Workspace
from refdgs_pipe.errors import Cancelled, InputError, RefdgsError
from refdgs_pipe.formatting import duration
from refdgs_pipe.pipeline.events import Event, Finished, Started
from refdgs_pipe.pipeline.store import Store

SCORED = "evaluate"  # the last stage that a cell needs
SEED = "start.seed"
SEEDS = {SEED, "train.seed"}  # today, and in older versions
_COLORS = re.compile("\x1b\\[[0-9;]*m")  # libraries write errors for terminals

T = TypeVar("T")


@dataclass(frozen=True)
class Cell:
    """One run of the grid."""

    row: Row
    space: Workspace


def listed(text: str, option: str) -> list[str]:
    """The words of "a,b".

    Raises:
        InputError: there are none.
    """
    words = [word.strip() for word in text.split(",") if word.strip()]
    if not words:
        raise InputError(f"{option} {text!r}: expected at least one, as in {option} a,b")
    return words


def seeds_of(text: str) -> list[int]:
    """The numbers of "0,1,2".

    Raises:
        InputError: they are none.
    """
    words = listed(text, "--seeds")
    if not all(word.isdecimal() for word in words):
        raise InputError(f"--seeds {text}: expected whole numbers from 0 on, as in --seeds 0,1,2")
    return [int(word) for word in words]


def plan_grid(
    scenes: Sequence[Path],
    recipes: Sequence[str],
    seeds: Sequence[int],
    out: Path,
    assignments: Sequence[str],
) -> list[Cell]:
    """Every cell, the first seed of all scenes before the second of any. Nothing is written.

    Raises:
        InputError: a recipe or setting is wrong, or two scenes or recipes have one name.
        CaptureError: a scene is not there.
    """
    if any(text.partition("=")[0].strip() in SEEDS for text in assignments):
        raise InputError(f"--set {SEED}: the seeds of a bench are given by --seeds")
    paths = _named("scenes", [(_scene_name(path), spaces.absolute(path)) for path in scenes])
    names = _named("recipes", [(Path(r).stem, spaces.absolute_recipe(r)) for r in recipes])
    cells = []
    for seed in dict.fromkeys(seeds):
        for scene, path in paths.items():
            for name, recipe in names.items():
                memory = Memory((path,), recipe, (*assignments, f"{SEED}={seed}"))
                space = spaces.open_workspace(out / f"{scene}-{name}-s{seed}.refdgs", memory)
                space.pipeline.stage(SCORED)
                space.source.files()  # a missing scene is said before hours of work on others
                row = Row(scene, name, seed, space.root.name, tuple(memory.assignments))
                cells.append(Cell(row, space))
    return cells


def run_grid(cells: Sequence[Cell], out: Path, options: Options) -> list[Row]:
    """Run what is missing of every cell and keep bench.json and bench.md up to date.

    A cell that fails is noted with its reason, and the next one begins.

    Raises:
        Cancelled: a signal came. What is finished is kept; the next call goes on.
        WorkspaceBusy: another process runs a bench in this folder.
        WriteError: the folder cannot be written.
    """
    if options.device != "auto":
        choose_device(options.device)
    options = replace(options, until=SCORED)
    with Store(out).lock(), Stopper() as stopper:
        before = read_rows(out)
        rows = [before.get(cell.row.identity, cell.row) for cell in cells]
        write_tables(out, rows)
        for i, cell in enumerate(cells):
            if options.verbosity:
                print(f"\n[{i + 1}/{len(cells)}] {cell.space.root.name}", file=sys.stderr)
            rows[i] = _run_cell(cell, rows[i], options, stopper)
            write_tables(out, rows)
            if rows[i].status == "stopped":
                raise stopper.error(Cancelled(f"stopped in {cell.space.root.name}"))
            if rows[i].status == "failed":
                print(f"{cell.space.root.name}: {rows[i].reason}", file=sys.stderr)
    return rows


class _Watch:
    """How long the stage that is running has been running."""

    def __init__(self) -> None:
        self.stage: str | None = None
        self._since = 0.0

    def __call__(self, event: Event) -> None:
        if isinstance(event, Started):
            self.stage, self._since = event.stage, time.monotonic()
        elif isinstance(event, Finished):
            self.stage = None

    def spent_s(self) -> float:
        """Seconds in it until now."""
        return time.monotonic() - self._since


def _run_cell(cell: Cell, row: Row, options: Options, stopper: Stopper) -> Row:
    """The cell's row after an attempt to finish it; `row` is as the last call left it."""
    watch, space = _Watch(), cell.space
    fresh = replace(cell.row, stopped_s=row.stopped_s)
    try:
        steps, _ = bring_up_to(space, options, stopper=stopper, also=watch)
        (last,) = [step for step in steps if step.stage.name == SCORED]
        assert last.origin is not None
        figures = figures_of(space.pipeline.store.folder(last.origin))
    except Cancelled:
        return replace(fresh, status="stopped", stopped_s=_with_stop(row, space, watch))
    except RefdgsError as error:
        return replace(fresh, status="failed", reason=str(error), exit_code=error.exit_code)
    except Exception as error:  # a mistake of ours in one cell must not end a night's work
        words = _COLORS.sub("", f"internal error: {type(error).__name__}: {error}").split()
        reason = " ".join(words)
        if log := " ".join(getattr(error, "__notes__", [])):
            reason += f". The log is {log}"
        return replace(fresh, status="failed", reason=reason, exit_code=RefdgsError.exit_code)
    seconds = {
        step.stage.name: step.manifest.seconds + row.stopped_s.get(step.origin.key, 0.0)
        for step in steps
        if step.manifest and step.origin
    }
    return replace(fresh, status="done", figures=figures, seconds=seconds)


def _with_stop(row: Row, space: Workspace, watch: _Watch) -> dict[str, float]:
    """The row's `stopped_s` with the time that the stage took that was stopped now."""
    keys = {step.stage.name: step.origin.key for step in space.status() if step.origin}
    if watch.stage not in keys:
        return row.stopped_s
    key = keys[watch.stage]
    return row.stopped_s | {key: row.stopped_s.get(key, 0.0) + watch.spent_s()}


def summary(rows: Sequence[Row]) -> str:
    """How the grid ended, in a line."""
    failed = [row.workspace for row in rows if row.status == "failed"]
    took = duration(sum(row.total_s for row in rows))
    text = f"{len(rows) - len(failed)} of {len(rows)} cells finished, {took} of work"
    return text + (f"; failed: {', '.join(failed)}" if failed else "")


def _scene_name(path: Path) -> str:
    path = spaces.absolute(path)
    return path.parent.name if path.suffix == ".json" else path.name


def _named(what: str, items: list[tuple[str, T]]) -> dict[str, T]:
    """By name; the same thing twice counts once."""
    found: dict[str, T] = {}
    for name, item in items:
        if found.setdefault(name, item) != item:
            raise InputError(
                f"two {what} are called {name}: {found[name]} and {item}. Rename one of them"
            )
    return found
