"""One run, as the command line does it: lock, log, signals, progress, and the words at its end."""

import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refdgs_pipe.cli import libraries, mask_model, report
from refdgs_pipe.cli.closing import closing
from refdgs_pipe.cli.console import Console
from refdgs_pipe.cli.device import check_device, choose_device, core_count
from refdgs_pipe.cli.listening import Listener
from refdgs_pipe.cli.logs import RunLog
from refdgs_pipe.cli.signals import Stopper
from refdgs_pipe.cli.verdict import verdict_of
from refdgs_pipe.cli.workspace import Workspace, is_workspace
from refdgs_pipe.documents import write_json_text
from refdgs_pipe.errors import Cancelled, InputError, RefdgsError, WorkspaceBusy, WriteError
from refdgs_pipe.formatting import aligned, printable
from refdgs_pipe.pipeline.catalog import PUBLISHED
from refdgs_pipe.pipeline.events import Emit
from refdgs_pipe.pipeline.plan import Step
from refdgs_pipe.pipeline.runner import Request, run
from refdgs_pipe.pipeline.shared import Shared
from refdgs_pipe.stage_words import doing

DEGRADED = 3  # exit code of --strict when there were warnings, or the result is poor


@dataclass(frozen=True)
class Options:
    """How a run works and speaks. Nothing here changes a result."""

    until: str | None = None
    force: frozenset[str] = frozenset()
    device: str = "auto"
    threads: int = 0
    json: bool = False
    strict: bool = False
    verbosity: int = 1
    vram: int = 0  # bytes, 0: no limit
    cuda_graph: bool | None = None  # None: where recorded steps prove equal
    shared: Shared | None = None  # results of other machines


def shared_by(place: str | None) -> Shared | None:
    """The shared results that --cache names, after a first request; None where it names none.

    Raises:
        InputError: there is no such place, or obstore is not installed.
        DiskFault: it cannot be reached.
    """
    if place is None:
        return None
    from refdgs_pipe.sharing.places import look_at

    return look_at(place)


def make(workspace: Workspace, options: Options) -> int:
    """Run the pipeline and say what came out. Return the exit code.

    Raises:
        RefdgsError: what went wrong, in words.
    """
    start = time.monotonic()
    try:
        steps, made = bring_up_to(workspace, options)
    except (Cancelled, WorkspaceBusy, WriteError):
        raise
    except RefdgsError:
        if is_workspace(workspace.root):
            report.write_if_possible(workspace, threads=options.threads)
        raise
    drawing = time.monotonic()
    if options.verbosity:
        print(f"report: {doing('report')}", file=sys.stderr)
    page = report.write_if_possible(workspace, threads=options.threads)
    drawn_s = time.monotonic() - drawing
    verdict = verdict_of(workspace)
    record = _record(workspace, steps, made, time.monotonic() - start) | {
        "report": page and str(page),
        "report_seconds": round(drawn_s, 3),
        "verdict": verdict and verdict.record(),
    }
    if options.json:
        _print_json(record)
    else:
        if options.verbosity:
            for line in closing(workspace, record, steps, verdict):
                print(printable(line), file=sys.stderr)
        if record["asset"]:
            print(record["asset"])
    is_poor = verdict is not None and verdict.word == "poor"
    return DEGRADED if options.strict and (is_poor or record["status"] == "degraded") else 0


def bring_up_to(
    workspace: Workspace,
    options: Options,
    *,
    stopper: Stopper | None = None,
    also: Emit = lambda _: None,
) -> tuple[list[Step], dict[str, float]]:
    """Run the pipeline. Return the stages asked for, and what was made in how many seconds.

    Args:
        stopper: that of a caller who makes several workspaces; without one signals stop this run.
        also: hears every event besides the log and the console.

    Raises:
        RefdgsError: what went wrong, in words.
    """
    check_device(options.device)
    with workspace.pipeline.store.lock():
        if stopper is not None:
            return _run_logged(workspace, options, stopper, also)
        with Stopper() as own:
            return _run_logged(workspace, options, own, also)


def _run_logged(
    workspace: Workspace, options: Options, stopper: Stopper, also: Emit
) -> tuple[list[Step], dict[str, float]]:
    """Run with the log, the console and `also` listening."""
    before = workspace.status()
    open_ = [s.stage.name for s in before if s.manifest is None or s.stage.name in options.force]
    wanted = [stage.name for stage in workspace.pipeline.needed_for(options.until)]
    to_make = [name for name in wanted if name in open_]
    libraries.require(_programs(workspace, to_make))
    if mask_model.STAGE in to_make:
        _try_network(workspace, stopper)
    workspace.memory.write(workspace.root)
    log, console = RunLog(workspace.root), Console(verbosity=options.verbosity)
    cores = options.threads or core_count()
    listen = Listener(workspace, console, log, before, to_make, cores, also)
    with console:
        request = Request(
            until=options.until,
            force=options.force,
            device=lambda: choose_device(options.device),
            threads=cores,
            vram=options.vram,
            cuda_graph=options.cuda_graph,
            stop=stopper.stop,
            publish=PUBLISHED,
            shared=options.shared,
        )
        log.write("run", workspace=str(workspace.root), settings=settings_json(workspace))
        try:
            steps = run(workspace.pipeline, workspace.source, workspace.settings, listen, request)
        except Cancelled as error:
            ended = stopper.error(error)
            log.error(ended)
            raise ended from None
        except BaseException as error:
            log.error(error)
            raise
        finally:
            log.close()
    return steps, listen.made


def _programs(workspace: Workspace, stages: Sequence[str]) -> set[str]:
    """The distributions that stages use."""
    wanted = [stage for stage in workspace.pipeline.stages if stage.name in stages]
    return {name for stage in wanted for name in stage.programs}


def _try_network(workspace: Workspace, stopper: Stopper) -> None:
    """Refuse a network for masks that cannot be used, before the workspace remembers it."""
    try:
        mask_model.check(workspace.settings, stopper.stop)
    except Cancelled as error:
        raise stopper.error(error) from None


def within(workspace: Workspace, again: set[str], until: str | None) -> set[str]:
    """The stages to make again, as far as `until` reaches.

    Raises:
        InputError: it reaches none of them.
    """
    wanted = {stage.name for stage in workspace.pipeline.needed_for(until)}
    if again and not again & wanted:
        first = next(name for name in workspace.pipeline.names if name in again)
        raise InputError(
            f"{first} is not made by --until {until}: nothing would be made again. Leave --until "
            f"out, or give --until {first} or a later stage"
        )
    return again & wanted


def print_plan(workspace: Workspace, options: Options) -> None:
    """Say what a run would do, and why.

    Raises:
        RefdgsError: what would end the run before its first stage.
    """
    wanted = workspace.pipeline.needed_for(options.until)
    steps = [step for step in workspace.status() if step.stage in wanted]
    _check_place(workspace.root)
    to_make = [s.stage.name for s in steps if s.manifest is None or s.stage.name in options.force]
    libraries.require(_programs(workspace, to_make))
    if mask_model.STAGE in to_make:
        mask_model.check(workspace.settings, threading.Event())
    if options.json:
        settings = settings_json(workspace)
        _print_json({"settings": settings, "stages": steps_json(steps, workspace)})
        return
    asked = {s.stage.name for s in steps if s.stage.name in options.force and s.manifest}
    rows = [(s.stage.name, "asked for again" if s.stage.name in asked else s.reason) for s in steps]
    print("\n".join(map(printable, aligned(rows))))


def _check_place(root: Path) -> None:
    """Refuse a place for a workspace that cannot be written.

    Raises:
        WriteError: it cannot.
    """
    place = next(path for path in (root, *root.parents) if os.path.lexists(path))
    if not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
        raise WriteError(f"{printable(place)}: cannot write here. Choose another with -w")


def settings_json(workspace: Workspace) -> dict[str, Any]:
    """Every setting of every stage."""
    return {name: params.model_dump(mode="json") for name, params in workspace.settings.items()}


def steps_json(steps: Sequence[Step], workspace: Workspace) -> list[dict[str, Any]]:
    """How stages stand, for programs."""
    records = []
    for step in steps:
        record: dict[str, Any] = {
            "stage": step.stage.name,
            "state": step.state,
            "reason": step.reason,
        }
        if step.origin and step.manifest:
            record |= {
                "folder": str(workspace.pipeline.store.folder(step.origin)),
                "key": step.origin.key,
                "seconds": step.manifest.seconds,
                "warnings": list(step.manifest.warnings),
                "measures": {n: v for n, v, _ in step.manifest.measures},
            }
        records.append(record)
    return records


def _record(
    workspace: Workspace, steps: Sequence[Step], made: dict[str, float], seconds: float
) -> dict[str, Any]:
    warnings = [w for step in steps if step.manifest for w in step.manifest.warnings]
    published = {name for name in PUBLISHED if any(s.stage.name == name for s in steps)}
    folders = [workspace.root / PUBLISHED[name] for name in published]
    return {
        "status": "degraded" if warnings else "ok",
        "workspace": str(workspace.root),
        "asset": str(folders[0]) if folders else None,
        "files": _sizes(folders[0]) if folders else {},
        "size": _size_said(steps),
        "made": list(made),
        "seconds": round(seconds, 3),
        "warnings": warnings,
        "stages": steps_json(steps, workspace),
    }


def _size_said(steps: Sequence[Step]) -> str | None:
    """How long the asset is and what tells it, as the export says."""
    exports = [step.manifest for step in steps if step.stage.name == "export" and step.manifest]
    return next((str(v) for m in exports for n, v, _ in m.measures if n == "size"), None)


def _sizes(folder: Path) -> dict[str, int]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}


def _print_json(record: dict[str, Any]) -> None:
    print(write_json_text(record, indent=2))
