"""Whether a run is going on in a workspace, and what it is doing. Looking disturbs nobody."""

import fcntl
import json
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from refdgs_pipe.stage_words import doing

LOCK = ".lock"  # held by the process that works in the workspace
_TAIL = 64_000  # bytes at the end of a log that are read


@dataclass(frozen=True)
class Activity:
    """What a run that is going on does.

    Args:
        stage: the stage that is running; None between stages.
        label, done, total: the stage's own progress, as far as it told any.
    """

    stage: str | None = None
    label: str = ""
    done: int | None = None
    total: int | None = None

    @property
    def words(self) -> str:
        """For example: "running: train, training 1200/5000"."""
        if self.stage is None:
            return "running"
        if not self.label:
            return f"running: {self.stage}, {doing(self.stage)}"
        count = f" {self.done}/{self.total}" if self.total else ""
        return f"running: {self.stage}, {self.label}{count}"

    def record(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


def activity(root: Path) -> Activity | None:
    """What the run does that is going on in a workspace; None if there is none."""
    if not _is_locked(root):
        return None
    logs = sorted((root / "logs").glob("*.jsonl"))
    return _last(logs[-1]) if logs else Activity()


def _is_locked(root: Path) -> bool:
    """Whether another process holds the workspace's lock. It is only tried for a moment."""
    try:
        with (root / LOCK).open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
            fcntl.flock(file, fcntl.LOCK_UN)
    except OSError:  # no lock was ever taken here, or it cannot be read
        return False
    return False


def _last(log: Path) -> Activity:
    """What the end of a log tells."""
    found = Activity()
    with suppress(OSError), log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - _TAIL))
        for line in file.read().decode("utf-8", "replace").splitlines():
            with suppress(ValueError, TypeError, AttributeError):
                event = json.loads(line)
                found = _after(found, event)
    return found


def _after(found: Activity, event: dict[str, Any]) -> Activity:
    kind, stage = event.get("event"), str(event.get("stage", ""))
    if kind == "started":
        return Activity(stage)
    if kind == "progress":
        done, total = int(event.get("done", 0)), event.get("total")
        return Activity(
            stage, str(event.get("label", "")), done, None if total is None else int(total)
        )
    return Activity() if kind == "finished" else found
