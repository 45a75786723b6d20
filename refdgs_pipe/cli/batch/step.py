"""`batch step`: one job of one capture, as Snakemake starts it. Its result is written last."""

import socket
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from refdgs_pipe.cli import report
from refdgs_pipe.cli.batch.gpus import own_gpu
from refdgs_pipe.cli.batch.parts import ENDS, PERMANENT, Attempts, Result, requests
from refdgs_pipe.cli.batch.table import Batch, Capture
from refdgs_pipe.cli.device import choose_device
from refdgs_pipe.cli.running import Options, bring_up_to
from refdgs_pipe.cli.verdict import verdict_of
from refdgs_pipe.cli.workspace import Workspace, is_workspace
from refdgs_pipe.errors import InputError, RefdgsError, WorkspaceBusy
from refdgs_pipe.formatting import printable, printable_lines
from refdgs_pipe.pipeline.catalog import PUBLISHED
from refdgs_pipe.pipeline.events import Event, Fetched
from refdgs_pipe.pipeline.plan import Step
from refdgs_pipe.sharing.places import open_place
from refdgs_pipe.trouble import explained

_PAUSE_S = 0.5


@dataclass(frozen=True)
class How:
    """How a job works. Nothing here changes a result.

    Args:
        wait_s: how long to wait while another process works in the workspace.
    """

    device: str = "cpu"
    threads: int = 0
    wait_s: float = 600.0


@dataclass
class _Work:
    """A job that is going on."""

    batch: Batch
    capture: Capture
    part: str
    how: How
    started: float = field(default_factory=time.monotonic)

    def result(self, status: str, asked: str) -> Result:
        ended = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        seconds = round(time.monotonic() - self.started, 3)
        return Result(
            self.capture.name,
            self.part,
            status,
            asked,
            seconds=seconds,
            host=socket.gethostname(),
            ended_utc=ended,
        )


def step(batch: Batch, name: str, part: str, how: How) -> Result:
    """Do one job of a capture, and leave its result.

    What another attempt cannot mend is a result too: the batch goes on with other captures.

    Raises:
        RefdgsError: what another attempt may mend; no result is left, so that there will be one.
    """
    if part not in ENDS:
        raise InputError(f"{printable(part)}: no such job. There are: {', '.join(ENDS)}")
    work = _Work(batch, batch.capture(name), part, how)
    before = list(ENDS)[: list(ENDS).index(part)]
    failed = [p for p in before if (r := Result.read(batch, name, p)) and r.status != "done"]
    if failed:
        earlier = Result.read(batch, name, failed[0])
        assert earlier is not None
        return _left(work, "skipped", _asked(work), f"{failed[0]} failed", earlier.exit_code)
    attempts = Attempts.read(batch, name, part).begun()
    attempts.write(batch, name, part)
    try:
        return _attempt(work)
    except RefdgsError as error:
        return _failed(work, attempts, error)
    except Exception as error:
        if found := explained(error):
            return _failed(work, attempts, found)
        traceback.print_exception(error)
        words = " ".join(f"internal error: {type(error).__name__}: {error}".split())
        return _failed(work, attempts, RefdgsError(words))


def _attempt(work: _Work) -> Result:
    space = work.batch.open(work.capture)
    with _alone(space, work.how.wait_s), _device(work.how.device) as device:
        asked = requests(space)[work.part]
        cache = work.batch.cache
        options = Options(
            until=ENDS[work.part],
            device=device,
            threads=work.how.threads,
            shared=open_place(cache) if cache else None,
        )
        fetched: list[str] = []

        def hear(event: Event) -> None:
            if isinstance(event, Fetched):
                fetched.append(event.stage)

        steps, made = bring_up_to(space, options, also=hear)
        result = work.result("done", asked)
        changes: dict[str, Any] = {"made": made, "fetched": fetched, "device": device}
        if work.part == "finish":
            changes |= _finished(work, space, steps)
        return _write(work, result, changes)


def _finished(work: _Work, space: Workspace, steps: list[Step]) -> dict[str, Any]:
    """What only a whole capture has: verdict, warnings, report and asset."""
    page = report.write_if_possible(space, threads=work.how.threads)
    verdict = verdict_of(space)
    asset = space.root / PUBLISHED["export"]
    root = work.batch.root
    return {
        "verdict": verdict and {"word": verdict.word, "line": verdict.line, "score": verdict.score},
        "warnings": [w for s in steps if s.manifest for w in s.manifest.warnings],
        "asset": asset.relative_to(root).as_posix() if asset.is_dir() else None,
        "report": page and page.relative_to(root).as_posix(),
    }


def _failed(work: _Work, attempts: Attempts, error: RefdgsError) -> Result:
    """Leave a result if no other attempt can help; else note the attempt and raise the error."""
    if error.exit_code not in PERMANENT:
        attempts.ended(error).write(work.batch, work.capture.name, work.part)
        raise error
    print(printable_lines(f"error: {error}"), file=sys.stderr)
    kind = type(error).__name__
    return _left(work, "failed", _asked(work), str(error), error.exit_code, kind=kind)


def _left(
    work: _Work, status: str, asked: str, message: str, exit_code: int, *, kind: str = ""
) -> Result:
    """The result of a job that made nothing; with a report, where there is a workspace."""
    page = work.batch.workspace(work.capture)
    changes: dict[str, Any] = {"message": message, "exit_code": exit_code, "kind": kind}
    if status == "failed" and is_workspace(page):
        written = report.write_if_possible(work.batch.open(work.capture), threads=1)
        changes["report"] = written and written.relative_to(work.batch.root).as_posix()
    return _write(work, work.result(status, asked), changes)


def _write(work: _Work, result: Result, changes: dict[str, Any]) -> Result:
    result = replace(result, **changes)
    result.write(work.batch)
    attempts = Attempts.read(work.batch, work.capture.name, work.part)
    if attempts.count:
        Attempts(attempts.count).write(work.batch, work.capture.name, work.part)
    return result


def _asked(work: _Work) -> str:
    try:
        return requests(work.batch.open(work.capture))[work.part]
    except RefdgsError:
        return ""


@contextmanager
def _alone(space: Workspace, wait_s: float) -> Iterator[None]:
    """Hold the workspace's lock. A job that is still running elsewhere is waited for.

    Raises:
        WorkspaceBusy: it still is, after `wait_s`.
    """
    until = time.monotonic() + wait_s
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(space.pipeline.store.lock())
                break
            except WorkspaceBusy:
                if time.monotonic() >= until:
                    raise
            time.sleep(_PAUSE_S)
        yield


@contextmanager
def _device(wanted: str) -> Iterator[str]:
    """The device to work on; if it may be a GPU, one that no other job on this machine has."""
    if wanted == "cpu":
        yield "cpu"
        return
    with own_gpu():
        yield choose_device(wanted)
