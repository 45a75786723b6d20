"""`batch run`: hand to Snakemake what is not finished, and say how it ended."""

import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from refdgs_pipe.cli.batch.init import SNAKEFILE, profile_path
from refdgs_pipe.cli.batch.parts import FOLDER, settle
from refdgs_pipe.cli.batch.standing import Standing, describe, standings
from refdgs_pipe.cli.batch.table import Batch
from refdgs_pipe.cli.device import core_count, has_driver
from refdgs_pipe.cli.gpus import visible_gpus
from refdgs_pipe.cli.running import shared_by
from refdgs_pipe.cli.signals import SIGNALS
from refdgs_pipe.errors import Cancelled, InputError, Interrupted, WorkspaceBusy
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline.atomic import disk_errors

LOCK = ".running"  # held while Snakemake works
# ours alone: a person's profile must not change what is taken for finished
_FIXED = (
    *("--nolock", "--ignore-incomplete", "--keep-going", "--drop-metadata"),
    *("--rerun-triggers", "mtime", "--scheduler", "greedy"),
)


@dataclass(frozen=True)
class Plan:
    """How a batch is run.

    Args:
        gpus: at most so many jobs on a GPU at once; None: on this machine all there are.
        shard: captures that Snakemake is given at once.
    """

    profile: str = "local"
    cores: int = 0
    gpus: int | None = None
    shard: int = 1000
    retry_failed: bool = False
    dry_run: bool = False


def run(batch: Batch, plan: Plan) -> list[Standing]:
    """Bring every capture of a batch to its end. Return how they stand afterwards.

    Raises:
        InputError: Snakemake is not installed, there is no such profile, or no such cache.
        DiskFault: the cache cannot be reached.
        WorkspaceBusy: the batch is running already.
        Cancelled: a signal came. What is finished is kept.
    """
    if not profile_path(batch.root, plan.profile).is_file():
        there = sorted(path.parent.name for path in batch.root.glob("profiles/*/config.yaml"))
        raise InputError(f"--profile {plan.profile}: there are {', '.join(there) or 'none'}")
    if find_spec("snakemake") is None:
        raise InputError(
            "batch run needs Snakemake 9: pip install 'snakemake<10' (the extra batch)"
        )
    shared_by(batch.cache)  # said once here, not by every job
    with _held(batch.root) as lock:
        open_ = [
            c.name for c in batch.captures if not settle(batch, c, retry_failed=plan.retry_failed)
        ]
        done = len(batch.captures) - len(open_)
        print(f"{done} of {len(batch.captures)} captures are up to date", file=sys.stderr)
        with _Passing(is_local=plan.profile == "local") as passing:
            for start in range(0, len(open_), plan.shard):
                names = open_[start : start + plan.shard]
                if len(open_) > plan.shard:
                    print(f"captures {start + 1} to {start + len(names)}", file=sys.stderr)
                passing.call(command(batch, plan, names), lock)
    return standings(batch)


def command(batch: Batch, plan: Plan, names: Sequence[str]) -> list[str]:
    """The call of Snakemake for these captures."""
    is_local = plan.profile == "local"
    gpus = plan.gpus
    if gpus is None:
        gpus = len(visible_gpus()) if has_driver() and is_local else 0
    amount = ["--cores", str(plan.cores or core_count())] if is_local or plan.cores else []
    return [
        *(sys.executable, "-m", "snakemake", "--snakefile", str(batch.root / SNAKEFILE)),
        *("--directory", str(batch.root)),
        *("--profile", str(profile_path(batch.root, plan.profile).parent)),
        *amount,
        *_FIXED,
        *("--resources", f"gpu={gpus}", "--config", f"root={batch.root}", f"gpus={gpus}"),
        *(["--dry-run"] if plan.dry_run else []),
        "--",
        *(f"{FOLDER}/{name}/finish.json" for name in names),
    ]


def exit_code(found: Sequence[Standing]) -> int:
    """0 if every capture is done, else that of the first that is not; 1 where it left none."""
    return next((one.exit_code or 1 for one in found if one.state != "done"), 0)


def summary(batch: Batch, found: Sequence[Standing]) -> list[str]:
    """How a batch ended, in lines."""
    lines = describe(found, every=False)
    if any(one.state == "to retry" for one in found):
        lines.append(f"try again: refdgs-pipe batch run {printable(batch.root)}")
    return lines


@contextmanager
def _held(root: Path) -> Iterator[int]:
    """Keep other runs of a batch out. Snakemake inherits the lock: it holds while either lives.

    Raises:
        WorkspaceBusy: the batch is running.
        WriteError: the folder cannot be written.
    """
    with disk_errors(root):
        handle = os.open(root / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
    try:
        with disk_errors(root):
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise WorkspaceBusy(
                    f"{printable(root)}: this batch is running. Wait for it, or stop it"
                ) from None
        yield handle
    finally:
        os.close(handle)


class _Passing:
    """While it is entered, signals go to the Snakemake that is running, and no other is begun.

    Args:
        is_local: the jobs are processes of this machine, and stop at their next safe point. Jobs
            of a cluster are cancelled by Snakemake.
    """

    def __init__(self, *, is_local: bool) -> None:
        self._is_local = is_local
        self._process: subprocess.Popen[bytes] | None = None
        self._signal: int | None = None

    def __enter__(self) -> "_Passing":
        self._old = {number: signal.signal(number, self._hear) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def call(self, words: Sequence[str], lock: int) -> None:
        """Run a command to its end; its output goes to stderr.

        Args:
            lock: a file that it holds open too.

        Raises:
            Cancelled: a signal came.
        """
        if self._signal is None:
            self._process = subprocess.Popen(
                words, stdout=sys.stderr.fileno(), pass_fds=[lock], start_new_session=True
            )
            self._process.wait()
        if self._signal is not None:
            kind = Interrupted if self._signal == signal.SIGTERM else Cancelled
            raise kind("stopped. What is finished is kept; run again to go on")

    def _hear(self, number: int, _: object) -> None:
        self._signal = number
        with suppress(ProcessLookupError):
            if self._process is not None and self._is_local:
                os.killpg(self._process.pid, signal.SIGTERM)
            elif self._process is not None:
                self._process.send_signal(signal.SIGINT)
