"""What is new in a workspace. Looking takes no lock, writes nothing and reads only small files."""

import os
import socket
import time
from calendar import timegm
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from refdgs_pipe.documents import read_text
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.pipeline.lock import LOCK, OWNER
from refdgs_pipe.pipeline.manifest import KEY, MANIFEST, Manifest, check_sizes
from refdgs_pipe.pipeline.store import CURRENT
from refdgs_pipe.viewing.story import TRAINED, Logs, Story

Mark: TypeAlias = tuple[str, int]  # changes when what it is of is replaced

CHECKPOINT = "checkpoint.safetensors"  # in a scratch folder, see training/checkpoint.py
_NOTE = 10_000  # bytes
_IDLE_S = 0.1  # core-seconds between two looks: a process that only waits spends less
_SILENT_S = 30.0  # a run whose process cannot be looked at is taken to run while its log grows


@dataclass(frozen=True)
class Found:
    """A finished result.

    Args:
        made: when, seconds since 1970.
    """

    folder: Path
    mark: Mark
    made: float
    manifest: Manifest


@dataclass(frozen=True)
class Begun:
    """A checkpoint of a training that goes on, or was stopped."""

    path: Path
    mark: Mark
    made: float
    stage: str


@dataclass(frozen=True)
class Seen:
    """A workspace at one moment.

    Args:
        results: stage -> the newest result, of stages whose results fit those before them.
        older: stages whose result was made from other inputs than there are now.
        troubles: stage -> what is wrong with its result, in a sentence.
        begun: the newest checkpoint, if it is newer than the results that it was made from.
        is_running: whether a process works in the workspace.
        run_s: core-seconds that it has spent, if that can be told. A run that has let go of the
            workspace still has one while it works on, as on its report.
    """

    results: Mapping[str, Found] = field(default_factory=dict)
    older: tuple[str, ...] = ()
    troubles: Mapping[str, str] = field(default_factory=dict)
    begun: Begun | None = None
    story: Story = field(default_factory=Story)
    is_running: bool = False
    run_s: float | None = None

    @property
    def stage(self) -> str | None:
        """The stage that runs now."""
        return self.story.stage if self.is_running else None


class Watch:
    """Looks at a workspace again and again.

    Args:
        root: the workspace; it may not be there yet.
        stages: in their order.
    """

    def __init__(self, root: Path, stages: Sequence[str]) -> None:
        self.root, self.stages = root, tuple(stages)
        self._logs = Logs(root / "logs")
        self._known: dict[str, tuple[Mark, Found | str]] = {}
        self._spent: float | None = None  # by the process that held the lock last

    def look(self) -> Seen:
        """What is there now. What cannot be read is a trouble, never an error."""
        found: dict[str, Found] = {}
        troubles: dict[str, str] = {}
        for stage in self.stages:
            result = self._result(stage)
            if isinstance(result, str):
                troubles[stage] = result
            elif result is not None:
                found[stage] = result
        fitting = _fitting(found, self.stages)
        older = tuple(stage for stage in found if stage not in fitting)
        story = self._logs.read()
        running = is_held(self.root, story)
        spent = spent_by_run(self.root)
        works_on = spent is not None and self._spent is not None and spent > self._spent + _IDLE_S
        self._spent, spent = spent, spent if running or works_on else None
        return Seen(fitting, older, troubles, self._begun(fitting), story, running, spent)

    def _result(self, stage: str) -> Found | str | None:
        """The newest result of a stage; a sentence if it is damaged; None if there is none."""
        folder = self.root / stage
        try:
            key = read_text(folder / CURRENT, limit=_NOTE, follow=False).strip()
            if not KEY.fullmatch(key):
                raise ValueError("no key")
            mark = (key, (folder / key / MANIFEST).stat().st_mtime_ns)
        except FileNotFoundError:
            return None  # or just being replaced: the next look finds it
        except (OSError, ValueError) as error:
            return f"{stage}: which result is current cannot be read ({error})"
        if stage not in self._known or self._known[stage][0] != mark:
            self._known[stage] = (mark, self._read(stage, mark))
        return self._known[stage][1]

    def _read(self, stage: str, mark: Mark) -> Found | str:
        folder = self.root / stage / mark[0]
        try:
            manifest = Manifest.read(folder)
            check_sizes(folder, manifest)
        except (CorruptError, OSError) as error:
            return f"{stage}: {error}. It is not shown; `run` makes it again"
        made = float(mark[1]) / 1e9
        with suppress(ValueError):
            made = float(timegm(time.strptime(manifest.made_utc, "%Y-%m-%dT%H:%M:%SZ")))
        return Found(folder, mark, made, manifest)

    def _begun(self, results: Mapping[str, Found]) -> Begun | None:
        """The newest checkpoint of a stage that trains."""
        before = max((results[s].made for s in ("gate", "start") if s in results), default=0.0)
        best: Begun | None = None
        for stage in TRAINED:
            with suppress(OSError):
                for path in (self.root / stage).glob(f".scratch-*/{CHECKPOINT}"):
                    found = path.lstat()
                    made = found.st_mtime
                    if made >= before and (best is None or made > best.made):
                        best = Begun(path, (str(path), found.st_mtime_ns), made, stage)
        return best


def _fitting(found: Mapping[str, Found], stages: Sequence[str]) -> dict[str, Found]:
    """Those results whose inputs are what the earlier stages have now."""
    digests: set[str] = set()
    fitting: dict[str, Found] = {}
    for number, stage in enumerate(stages):
        if stage in found:
            inputs = found[stage].manifest.origin.inputs
            if number == 0:
                digests.update(inputs.values())  # of the photos
            if digests.issuperset(inputs.values()):
                fitting[stage] = found[stage]
                digests.add(found[stage].manifest.digest)
    return fitting


def is_held(root: Path, story: Story) -> bool:
    """Whether a run goes on in a workspace. The lock is not touched: a run may just begin.

    The process that noted itself as the holder must have the lock's file open. Where that cannot
    be seen (another user, another machine, another system), its log must have grown lately.
    """
    process, host = _holder(root)
    if process is None:
        return False
    with suppress(OSError):
        if host == socket.gethostname() and Path("/proc/self/fd").exists():
            handles = Path(f"/proc/{process}/fd")
            if not handles.exists():
                return False
            lock = (root / LOCK).stat()
            return any(_is_same(path, lock) for path in handles.iterdir())
    return story.told is not None and time.time() - story.told < _SILENT_S


def spent_by_run(root: Path) -> float | None:
    """Core-seconds of the process that noted itself as the holder, and of its ended children.

    None if it is not on this machine, or cannot be looked at.
    """
    process, host = _holder(root)
    if process is None or host != socket.gethostname():
        return None
    with suppress(OSError, ValueError):
        fields = Path(f"/proc/{process}/stat").read_text("utf-8").rpartition(")")[2].split()
        ticks = sum(map(int, fields[11:15]))  # utime, stime, cutime, cstime; see proc(5)
        return ticks / os.sysconf("SC_CLK_TCK")
    return None


def _holder(root: Path) -> tuple[int | None, str]:
    """Process and machine that hold the lock, or held it last, as they noted."""
    with suppress(OSError, ValueError):
        number, host = read_text(root / OWNER, limit=_NOTE, follow=False).split(maxsplit=1)
        return int(number), host
    return None, ""


def _is_same(path: Path, lock: os.stat_result) -> bool:
    with suppress(OSError):
        found = path.stat()
        return (found.st_dev, found.st_ino) == (lock.st_dev, lock.st_ino)
    return False
