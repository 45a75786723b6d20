"""The view that `run --view` starts: a process of its own, which the run does not depend on."""

import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from refdgs_pipe.formatting import printable

_END_S = 5.0  # for the view to end once it was told to


@contextmanager
def accompanied(root: Path, *, wanted: bool, threads: int) -> Iterator[None]:
    """Show a workspace while a run goes on in it.

    At a terminal the view stays after a run that went well, until Ctrl-C; else it ends with the
    run. Nothing that becomes of the view changes what the run does or ends with.

    Args:
        wanted: without it nothing happens.
        threads: of the run.

    Raises:
        InputError: viser is not installed, or no port is free.
    """
    if not wanted:
        yield
        return
    from refdgs_pipe.viewing.server import address, check_installed, free_port

    check_installed()
    port = free_port()
    where = [str(root), "--port", str(port), "--with-run", str(threads)]
    command = [sys.executable, "-m", "refdgs_pipe", "view", *where]
    print(f"view: {address(port)}", file=sys.stderr, flush=True)
    companion = Companion(command, again=f"refdgs-pipe view {printable(root)}")
    try:
        yield
        if sys.stdin.isatty() and sys.stderr.isatty():
            companion.stay(f"view: still at {address(port)}; Ctrl-C ends it")
    finally:
        companion.end()


class Companion:
    """A process beside the run. Ctrl-C at the terminal does not reach it.

    Args:
        command: what to start.
        again: how the user starts it again, for the warning if it ends by itself.
    """

    def __init__(self, command: Sequence[str], *, again: str) -> None:
        self._again, self._is_over = again, False
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def stay(self, text: str) -> None:
        """Say something and wait until the process ends, or Ctrl-C."""
        if self.process.poll() is None:
            with suppress(KeyboardInterrupt):  # it may come as soon as the text is there
                print(text, file=sys.stderr, flush=True)
                self.process.wait()

    def end(self) -> None:
        """Let it end now."""
        self._is_over = self.process.poll() is None
        self.process.terminate()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
        self._listener.join(_END_S)

    def _listen(self) -> None:
        """Take in what it says; warn, in one line, if it ends by itself."""
        assert self.process.stderr is not None
        last = deque((line.strip() for line in self.process.stderr if line.strip()), maxlen=1)
        code = self.process.wait()
        if not self._is_over:
            why = f": {printable(last[0])}" if last and code > 0 else ""
            print(
                f"warning: the view ended (exit code {code}){why}. The run goes on. To start the "
                f"view again: {self._again}",
                file=sys.stderr,
                flush=True,
            )
