"""The log of a run: one JSON object a line, in the workspace's logs/."""

import os
import re
import tempfile
import time
import traceback
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from refdgs_pipe.documents import write_json_text
from refdgs_pipe.errors import RefdgsError
from refdgs_pipe.pipeline.events import Event, Progress, Sampled
from refdgs_pipe.trouble import explained

KEPT = 50  # older logs go
_NAME = re.compile(r"\d{8}-\d{6}-\d+\.jsonl")  # no other file in the folder is ours
EVERY_S = 2.0  # at most one line of progress and one of figures in this time


class RunLog:
    """Writes events as they come. A disk that cannot take them does not end the run."""

    def __init__(self, root: Path) -> None:
        stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
        self.path = root / "logs" / f"{stamp}-{os.getpid()}.jsonl"
        self._file: IO[str] | None = None
        self._last: dict[type[Event], float] = {}
        with suppress(OSError):
            if self.path.parent.is_symlink():
                return  # a workspace holds no links: nothing is written or deleted elsewhere
            self.path.parent.mkdir(parents=True, exist_ok=True)
            logs = [path for path in self.path.parent.iterdir() if _NAME.fullmatch(path.name)]
            for old in sorted(logs)[: -KEPT + 1]:
                old.unlink()
            self._file = self.path.open("x", encoding="utf-8", buffering=1)

    def __call__(self, event: Event) -> None:
        if isinstance(event, Progress | Sampled):
            now, kind = time.monotonic(), type(event)
            if now - self._last.get(kind, -EVERY_S) < EVERY_S and not _is_last(event):
                return
            self._last[kind] = now
        self.write(type(event).__name__.lower(), **asdict(event))

    def write(self, event: str, **record: Any) -> None:
        """Add a line."""
        if self._file is not None:
            line = {"time": round(time.time(), 3), "event": event, **record}
            with suppress(OSError):
                print(write_json_text(line, indent=None), file=self._file)

    def error(self, error: BaseException) -> None:
        """Add the end of a run that failed, with the traceback and a child's last words."""
        text = "".join(traceback.format_exception(error))
        found = explained(error) or error
        kind, code = type(found).__name__, getattr(found, "exit_code", 70)
        self.write("failed", kind=kind, exit_code=code, message=str(found), traceback=text)
        if not isinstance(found, RefdgsError) and self._file is not None:
            error.add_note(str(self.path))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            with suppress(OSError):
                self._file.close()


def _is_last(event: Progress | Sampled) -> bool:
    if isinstance(event, Sampled):
        return event.step == event.steps
    return event.done == event.total


def keep_traceback(error: Exception) -> str:
    """Where an error's traceback is: in the run's log, or in a new file."""
    for note in getattr(error, "__notes__", []):
        if note.endswith(".jsonl"):
            return str(note)
    with tempfile.NamedTemporaryFile(
        "w", prefix="refdgs-pipe-", suffix=".log", delete=False
    ) as file:
        traceback.print_exception(error, file=file)
    return file.name
