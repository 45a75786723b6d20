"""Ctrl-C and SIGTERM: the first asks the run to stop, the second ends the process at once."""

import os
import signal
import sys
import threading
from types import TracebackType
from typing import Self

from refdgs_pipe.errors import Cancelled, Interrupted

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopper:
    """While it is entered, signals set `stop`. A thread listens: native code cannot delay it."""

    def __init__(self) -> None:
        self.stop = threading.Event()
        self.was_terminated = False

    def __enter__(self) -> Self:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._old = {number: signal.signal(number, lambda *_: None) for number in SIGNALS}
        self._old_fd = signal.set_wakeup_fd(self._writer)
        threading.Thread(target=self._listen, args=(self._reader,), daemon=True).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        signal.set_wakeup_fd(self._old_fd)
        for number, handler in self._old.items():
            signal.signal(number, handler)
        os.close(self._writer)  # ends the thread

    def error(self, cancelled: Cancelled) -> Cancelled:
        """The error that a cancelled run ends with: Interrupted after SIGTERM."""
        hint = "What is finished is kept; run again to go on"
        kind = Interrupted if self.was_terminated else Cancelled
        return kind(f"{cancelled}. {hint}")

    def _listen(self, reader: int) -> None:
        while data := os.read(reader, 16):
            for number in data:
                if number not in SIGNALS:
                    continue
                if self.stop.is_set():
                    os._exit(Interrupted.exit_code if self.was_terminated else Cancelled.exit_code)
                self.was_terminated = number == signal.SIGTERM
                self.stop.set()
                again = "" if self.was_terminated else " (Ctrl-C again: stop at once)"
                print(f"stopping at the next safe point{again}", file=sys.stderr, flush=True)
        os.close(reader)
