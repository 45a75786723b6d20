"""How far a run is: read from its log and from what it says. No bpy here.

The log is one JSON object a line (WORKSPACE/logs/TIME-PID.jsonl). What the program says on stderr
has the time that is left, in its own words. Both files grow while they are read.
"""

import json
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

MOST = 4_000_000  # bytes read at once: a log that is larger is read over several calls
LONGEST = 2_000_000  # bytes of one line; a longer one is no line of ours
_LEFT = re.compile(r"(?:^|, )([^,]+ left in (?:all|this part))$")


@dataclass(frozen=True)
class Progress:
    """What a run does now.

    Args:
        stage: the stage that is running; "" between stages.
        label: the part of the stage.
        done, total: steps of that part; None: not known.
        work: 0 to 1, the share of the time that is behind, where steps differ in cost.
        left: the time to go, in the program's words: "about 3 min left in all".
        told: the last other line that the program said.
    """

    stage: str = ""
    label: str = ""
    done: int | None = None
    total: int | None = None
    work: float | None = None
    left: str = ""
    told: str = ""

    @property
    def words(self) -> str:
        """For example "train: training, 1200 of 5000"."""
        if not self.label:
            return self.told or self.stage or "starting"
        count = f", {self.done} of {self.total}" if self.total else ""
        return f"{self.stage}: {self.label}{count}"

    @property
    def share(self) -> float | None:
        """0 to 1: how much of this part is done; None if that is not known."""
        if self.work is not None:
            return min(max(self.work, 0.0), 1.0)
        if not self.total or self.done is None:
            return None
        return min(max(self.done / self.total, 0.0), 1.0)


class Tail:
    """Reads the whole lines that were added to a file since the last call."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._at = 0
        self._rest = b""

    def lines(self) -> list[str]:
        """The new lines, without their ends. A file that cannot be read has none."""
        new = b""
        with suppress(OSError), self.path.open("rb") as file:
            file.seek(self._at)
            new = file.read(MOST)
        self._at += len(new)
        *whole, self._rest = (self._rest + new).split(b"\n")
        if len(self._rest) > LONGEST:
            self._rest = b""
        return [line.decode("utf-8", "replace").rstrip("\r") for line in whole]


def after_event(now: Progress, line: str) -> Progress:
    """The progress after a line of the log. A line that is not understood changes nothing."""
    with suppress(ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        event = json.loads(line)
        kind, stage = event.get("event"), str(event.get("stage", ""))
        if kind == "started":
            return Progress(stage, left=_of_all(now.left), told=now.told)
        if kind == "progress":
            same = stage == now.stage and event.get("label") == now.label
            return replace(
                now,
                stage=stage,
                label=str(event.get("label", "")),
                done=int(event.get("done", 0)),
                total=_number(event.get("total"), int),
                work=_number(event.get("work"), float),
                left=now.left if same else _of_all(now.left),
            )
        if kind == "finished":
            return Progress(left=_of_all(now.left), told=now.told)
    return now


def after_words(now: Progress, line: str) -> Progress:
    """The progress after a line that the program said on stderr."""
    line = line.strip()
    if found := _LEFT.search(line):
        return replace(now, left=found[1].strip())
    return replace(now, told=line) if line else now


def log_of(folder: Path, pid: int, before: frozenset[str]) -> Path | None:
    """The log of a run that was started just now.

    Args:
        folder: the logs of the workspace.
        pid: the process that was started. A wrapper may have started the program in another one.
        before: the names of the logs that were there before.
    """
    names = sorted(names_of(folder) - before)
    own = [name for name in names if name.endswith(f"-{pid}.jsonl")]
    chosen = own or names
    return folder / chosen[-1] if chosen else None


def names_of(folder: Path) -> frozenset[str]:
    """The names of the logs in a folder. A link is none: workspaces hold no links."""
    with suppress(OSError):
        files = [path for path in folder.iterdir() if path.suffix == ".jsonl"]
        return frozenset(path.name for path in files if path.is_file() and not path.is_symlink())
    return frozenset()


def _of_all(left: str) -> str:
    """The time to go, if it is that of the whole run: that of a part is over with the part."""
    return left if left.endswith("in all") else ""


def _number(value: Any, kind: type[int] | type[float]) -> Any:
    return None if value is None else kind(value)
