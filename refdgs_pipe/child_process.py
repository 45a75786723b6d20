"""Run a function in a process of its own, so that a crash in native code is only an error.

Some libraries abort or segfault instead of raising. `call_in_child` starts a fresh interpreter for
one call, captures all that its C code prints, and turns a crash into an exception.
"""

import ctypes
import faulthandler
import importlib
import inspect
import json
import os
import pickle
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable
from typing import IO, Any, NoReturn, TypeAlias

from refdgs_pipe.errors import Cancelled, OutOfMemory, RefdgsError

OnProgress: TypeAlias = Callable[[str, int, int | None], None]

POLL_S = 0.05
GRACE_S = 3.0  # between asking a child to end and killing it
LOG_LINES = 40


class ChildCrashed(RefdgsError):
    """The process ended without an answer: a signal, an abort, or no memory left."""


class ChildKilled(ChildCrashed, OutOfMemory):
    """The process was killed from outside, as the system does where memory runs out."""

    exit_code = OutOfMemory.exit_code


class ChildTimeout(RefdgsError):
    """The process took longer than allowed and was killed."""


def call_in_child(
    target: str,
    arguments: dict[str, Any],
    *,
    timeout_s: float | None = None,
    stop: threading.Event | None = None,
    on_progress: OnProgress | None = None,
) -> Any:
    """Return what `target` returns, computed in a fresh interpreter.

    Args:
        target: "package.module:function"; it gets the arguments by name, and `progress(label,
            done, total)` if it has a parameter of that name.
        arguments: anything that pickles: arrays, paths, numbers, dataclasses. So for the result.
        stop: when set, the process is ended and Cancelled raised.

    Raises:
        ChildCrashed: the process died; the message has its last lines.
        ChildTimeout: it took longer than `timeout_s`.
        Cancelled: `stop` was set.
        RefdgsError: as raised by the target. Its other exceptions come back as themselves where
            they are built in, else as RuntimeError.
    """
    with (
        tempfile.TemporaryFile() as request,
        tempfile.TemporaryFile() as answer,
        tempfile.TemporaryFile() as log,
    ):
        pickle.dump((target, arguments), request, protocol=5)
        request.seek(0)
        read_end, write_end = os.pipe()
        with os.fdopen(read_end, "rb", buffering=0) as reports:
            try:
                process = _start((request.fileno(), answer.fileno(), write_end), log)
            finally:
                os.close(write_end)
            try:
                _watch(process, reports, timeout_s, stop, on_progress, target)
            except ChildTimeout as error:
                raise ChildTimeout(f"{error}\n{_tail(log)}".rstrip()) from None
            finally:
                _end(process)
        return _read_answer(target, process.returncode, answer, log)


def _start(fds: tuple[int, int, int], log: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start the interpreter. It sees our import path, and Ctrl-C reaches only us."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    code = "from refdgs_pipe.child_process import _serve; _serve()"
    return subprocess.Popen(
        [sys.executable, "-P", "-c", code, *map(str, fds), str(os.getpid())],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        pass_fds=fds,
        env=environment,
        start_new_session=True,
    )


def _watch(
    process: subprocess.Popen[bytes],
    reports: IO[bytes],
    timeout_s: float | None,
    stop: threading.Event | None,
    on_progress: OnProgress | None,
    target: str,
) -> None:
    """Pass reports on until the process ends."""
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    pending, is_open = b"", True
    while is_open or process.poll() is None:
        if stop is not None and stop.is_set():
            raise Cancelled(f"stopped during {target.partition(':')[2]}")
        if deadline is not None and time.monotonic() > deadline:
            raise ChildTimeout(f"{target} did not finish in {timeout_s:g} s and was stopped")
        if not is_open:
            time.sleep(POLL_S)
        elif select.select([reports], [], [], POLL_S)[0]:
            block = reports.read(65536)
            is_open = bool(block)
            *lines, pending = (pending + block).split(b"\n")
            for line in lines:
                if on_progress is not None:
                    on_progress(*json.loads(line))
        elif process.poll() is not None:
            is_open = False  # a grandchild may still hold the pipe


def _end(process: subprocess.Popen[bytes]) -> None:
    """Make sure that the process is gone."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _read_answer(target: str, returncode: int, answer: IO[bytes], log: IO[bytes]) -> Any:
    """The result of the call, or the exception that it ended with."""
    answer.seek(0)
    data = answer.read()
    if returncode != 0 or not data:
        kind = ChildKilled if returncode == -signal.SIGKILL else ChildCrashed
        raise kind(f"{target} {_cause(returncode)}\n{_tail(log)}".rstrip())
    is_error, value = pickle.loads(data)
    if is_error:
        raise value
    return value


def _cause(returncode: int) -> str:
    if returncode == -signal.SIGKILL:
        return "was killed (SIGKILL); the machine may have run out of memory"
    if returncode < 0:
        return f"crashed ({signal.Signals(-returncode).name})"
    return f"ended with exit code {returncode}"


def _tail(log: IO[bytes]) -> str:
    """The last lines that the process printed."""
    size = log.seek(0, os.SEEK_END)
    log.seek(max(0, size - 65536))
    lines = log.read().decode("utf-8", "replace").splitlines()
    return "\n".join(lines[-LOG_LINES:])


def _serve() -> NoReturn:
    """The child's side: read the call, make it, write the answer."""
    request, answer, reports, parent = map(int, sys.argv[1:5])
    _die_with(parent)
    faulthandler.enable()
    with os.fdopen(request, "rb") as file:
        target, arguments = pickle.load(file)
    try:
        result = False, _call(target, arguments, reports)
    except Exception as error:
        traceback.print_exc()
        result = True, _portable(error)
    with os.fdopen(answer, "wb") as file:
        pickle.dump(result, file, protocol=5)
        file.flush()
    sys.stdout.flush()
    os._exit(0)  # some native libraries crash while they are torn down


def _die_with(parent: int) -> None:
    """Let Linux end this process when the parent dies, however it dies."""
    if sys.platform == "linux":
        PR_SET_PDEATHSIG = 1
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)


def _call(target: str, arguments: dict[str, Any], reports: int) -> Any:
    module, _, name = target.partition(":")
    function = getattr(importlib.import_module(module), name)
    if "progress" not in inspect.signature(function).parameters:
        return function(**arguments)

    def progress(label: str, done: int, total: int | None) -> None:
        os.write(reports, json.dumps([label, done, total]).encode() + b"\n")

    return function(**arguments, progress=progress)


def _portable(error: Exception) -> Exception:
    """An exception that the parent can load without importing the library that raised it."""
    note = "".join(traceback.format_exception(error))
    if type(error).__module__.split(".")[0] not in ("builtins", "refdgs_pipe"):
        error = RuntimeError(f"{type(error).__name__}: {error}")
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.add_note(f"in the child process:\n{note}")
    return error
