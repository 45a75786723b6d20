"""The small command line in forks of one process that has loaded it: imports are paid once.

A fork is a process of its own: its signals, locks, output and exit code are real. What is shared is
the loaded modules and the seed of hashes. A test of how Python starts needs a start of its own.
"""

import atexit
import functools
import gc
import importlib
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

LOADED = (
    "fake_stages",
    "refdgs_pipe.cli.app",
    "refdgs_pipe.cli.bench",
    "refdgs_pipe.cli.report",
    "refdgs_pipe.cli.verify",
    "refdgs_pipe.reporting.page",
)
CLIENT = Path(__file__).with_name("fork_client.py")
_MOST_BYTES = 1 << 17  # of a request: arguments and environment


class Forked:
    """A program in a fork, with the part of `Popen` that tests use; stdin is empty.

    Args:
        words: a Python file and its arguments.
        folder: to run in; None: the present one.
        environment: all of it.
    """

    def __init__(
        self, words: Sequence[str], folder: Path | None, environment: Mapping[str, str]
    ) -> None:
        self.args, self.returncode = list(words), None
        self._out, self._err = _written(), _written()
        told, tell = os.pipe()
        self._told = os.fdopen(told)
        request = {"words": self.args, "folder": str(folder or Path.cwd()), "env": {**environment}}
        with Path(os.devnull).open("rb") as nothing:
            handles = [nothing.fileno(), self._out.fileno(), self._err.fileno(), tell]
            socket.send_fds(_server()[0], [json.dumps(request).encode()], handles)
        os.close(tell)
        number = self._told.readline()
        assert number, "the process that forks the command line has ended"
        self.pid = int(number)

    def poll(self) -> int | None:
        """Its exit code if it has ended."""
        with suppress(subprocess.TimeoutExpired):
            self.wait(0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end; its exit code, or that of a signal below 0."""
        if self.returncode is None:
            if not select.select([self._told], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(self.args, timeout or 0)
            with self._told:
                self.returncode = int(self._told.readline())
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Wait for its end; what it has written, once."""
        self.wait(timeout)
        with self._out, self._err:
            for file in (self._out, self._err):
                file.seek(0)
            return self._out.read(), self._err.read()

    def send_signal(self, number: int) -> None:
        """Signal it if it has not ended, as `Popen` does: it may end between the two."""
        if self.poll() is None:
            with suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)


Process = subprocess.Popen[str] | Forked


def _written() -> IO[str]:
    """A file without a name for what a program writes."""
    return tempfile.TemporaryFile("w+", encoding="utf-8", errors="surrogateescape")


def command(file: Path) -> list[str]:
    """Words with which any program runs a Python file in a fork; more words may follow."""
    return [sys.executable, "-I", "-S", str(CLIENT), str(_server()[1]), str(file)]


@functools.cache
def _server() -> tuple[socket.socket, Path]:
    """Two places to ask for forks. The process that makes them ends with this one."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    folder = tempfile.TemporaryDirectory(prefix="forking-")
    place = Path(folder.name) / "socket"
    door = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    door.bind(str(place))
    door.listen()
    paths = os.pathsep.join(path for path in sys.path if path)
    handles = [there.fileno(), door.fileno()]
    process = subprocess.Popen(
        [sys.executable, __file__, *map(str, handles)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=handles,
        env=os.environ | {"PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "1"},
    )
    there.close()
    door.close()

    def end() -> None:
        here.close()
        process.wait()
        folder.cleanup()

    atexit.register(end)
    return here, place


def _serve(channel: socket.socket, door: socket.socket) -> None:
    """Fork for every request until the tests have ended."""
    for name in LOADED:
        importlib.import_module(name)
    gc.freeze()  # forks leave the memory of what is loaded alone
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal: the tests end this process
    while True:
        asked = select.select([channel, door], [], [])[0][0]
        asking = channel if asked is channel else door.accept()[0]
        request, handles, _, _ = socket.recv_fds(asking, _MOST_BYTES, 4)
        if asking is not channel:
            asking.close()
        if not request:
            if asking is channel:
                return
            continue
        if os.fork() == 0:
            channel.close()
            door.close()
            _keep(json.loads(request), handles)
            return
        for handle in handles:
            os.close(handle)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


def _keep(request: dict[str, Any], handles: list[int]) -> None:
    """Fork the command; tell its number, and its exit code once it has ended."""
    *streams, tell = handles
    number = os.fork()
    if number == 0:
        os.close(tell)
        _become(request, streams)
        return
    for handle in streams:
        os.close(handle)
    os.write(tell, f"{number}\n".encode())
    _, status = os.waitpid(number, 0)
    os.write(tell, f"{os.waitstatus_to_exitcode(status)}\n".encode())
    os._exit(0)


def _become(request: dict[str, Any], streams: list[int]) -> None:
    """Be the program that was asked for."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for target, handle in enumerate(streams):
        os.dup2(handle, target)
        os.close(handle)
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["env"])
    sys.argv = request["words"]
    runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    _serve(*(socket.socket(fileno=int(handle)) for handle in sys.argv[1:]))
