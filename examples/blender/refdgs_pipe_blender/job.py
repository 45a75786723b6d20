"""A run of the program in the background: start it, look at it, stop it. No bpy here."""

import json
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from .errors import AddonError
from .program import environment
from .progress import Progress, Tail, after_event, after_words, log_of, names_of

DONE, STOPPED = 0, (130, 75)  # exit codes: as the README of refdgs-pipe says
ANSWER = 64_000_000  # bytes of the object at the end that are read


@dataclass(frozen=True)
class Ending:
    """How a run ended.

    Args:
        code: the program's exit code; negative if a signal ended it.
        message: one sentence: the verdict, or what went wrong.
        workspace: the folder of the results, if the program said it.
    """

    code: int
    message: str
    workspace: Path | None = None

    @property
    def is_error(self) -> bool:
        """Whether it went wrong. A run that the user stopped did not."""
        return self.code != DONE and self.code not in STOPPED

    @property
    def words(self) -> str:
        """The message; of an error with the exit code."""
        return f"{self.message} (exit code {self.code})" if self.is_error else self.message


class Job:
    """A process in a group and session of its own. Its output goes to files, so it never waits.

    Args:
        process: as it was started.
        folder: a new folder with the files `stdout` and `stderr`; it is deleted at the end.
        logs: the folder of the workspace's logs, which may not be there yet.
        before: the names of the logs that were there before.
    """

    def __init__(
        self, process: "subprocess.Popen[bytes]", folder: Path, logs: Path, before: frozenset[str]
    ) -> None:
        self.process = process
        self.progress = Progress()
        self.ending: Ending | None = None
        self.is_stopping = False
        self._folder, self._logs, self._before = folder, logs, before
        self._said = Tail(folder / "stderr")
        self._log: Tail | None = None

    @classmethod
    def start(cls, command: Sequence[str], workspace: Path) -> Self:
        """Start a run.

        Args:
            command: the program and its arguments, as `run_command` gives them.
            workspace: where the run writes its log.

        Raises:
            AddonError: it cannot be started, or this system has no process groups.
        """
        if os.name != "posix":
            raise AddonError(
                "refdgs-pipe runs on Linux. Run it there, copy the workspace to this machine, "
                "choose it under Workspace and press Import"
            )
        logs = workspace / "logs"
        before = names_of(logs)
        folder = Path(tempfile.mkdtemp(prefix="refdgs-pipe-blender-"))
        try:
            with (folder / "stdout").open("wb") as out, (folder / "stderr").open("wb") as said:
                process = subprocess.Popen(
                    list(command),
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=said,
                    start_new_session=True,
                    env=environment(),
                )
        except (OSError, ValueError) as error:  # ValueError: a NUL in a name
            shutil.rmtree(folder, ignore_errors=True)
            raise AddonError(
                f"{command[0]} cannot be started: {error}. Check its path in the preferences"
            ) from None
        return cls(process, folder, logs, before)

    def poll(self) -> Ending | None:
        """Read what is new. The ending once the process has ended, None before."""
        if self.ending is not None:
            return self.ending
        code = self.process.poll()  # before the files: what it wrote last is read, too
        for line in self._said.lines():
            self.progress = after_words(self.progress, line)
        if self._log is None and (path := log_of(self._logs, self.process.pid, self._before)):
            self._log = Tail(path)
        for line in self._log.lines() if self._log else ():
            self.progress = after_event(self.progress, line)
        if code is not None:
            answer = read_answer(self._folder / "stdout")
            self.ending = ending_of(code, answer, self.progress.told)
            self.progress = replace(self.progress, left="")
            shutil.rmtree(self._folder, ignore_errors=True)
        return self.ending

    def stop(self) -> None:
        """Ask the run to stop at its next safe point, as Ctrl-C does. What is finished is kept.

        A second call ends it at once.
        """
        self.is_stopping = True
        if self.process.poll() is None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGINT)

    def leave(self) -> None:
        """Stop the run and do not wait for its end: Blender closes."""
        self.stop()
        shutil.rmtree(self._folder, ignore_errors=True)


def read_answer(path: Path) -> dict[str, Any]:
    """The JSON object that the program printed; {} if it printed none."""
    with suppress(OSError, ValueError, RecursionError):
        if path.stat().st_size <= ANSWER:
            answer = json.loads(path.read_text("utf-8", "replace"))
            if isinstance(answer, dict):
                return answer
    return {}


def ending_of(code: int, answer: dict[str, Any], told: str) -> Ending:
    """How a run ended.

    Args:
        answer: what it printed on stdout: a result, or {"status": "failed", "message": ...}.
        told: the last line that it said on stderr.
    """
    place = answer.get("workspace")
    workspace = Path(place) if isinstance(place, str) and place else None
    if code in STOPPED:
        return Ending(code, "stopped. What is finished is kept; press Run to go on", workspace)
    if code == DONE:
        verdict = answer.get("verdict")
        line = verdict.get("line") if isinstance(verdict, dict) else None
        return Ending(code, str(line) if line else "done", workspace)
    said = str(answer.get("message") or told.removeprefix("error: ")).strip()
    if code < 0:
        ended = f"a signal ended refdgs-pipe ({-code}). Press Run to go on"
        return Ending(code, f"{ended}. It last said: {said}" if said else ended, workspace)
    return Ending(code, said or "refdgs-pipe ended without a message", workspace)
