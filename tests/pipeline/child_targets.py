"""Functions that the tests run in child processes."""

import ctypes
import os
import signal
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.errors import MeshError


def double(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values * 2


def count(upto: int, progress: Callable[[str, int, int | None], None]) -> int:
    for i in range(upto):
        progress("counting", i + 1, upto)
    return upto


def abort() -> None:
    os.write(1, b"".join(f"line {i}\n".encode() for i in range(100)))
    ctypes.CDLL(None).puts(b"said by C")
    ctypes.CDLL(None).fflush(None)
    os.abort()


def kill_self(**_: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def segfault(**_: Any) -> None:
    ctypes.string_at(0)


def hang(**_: Any) -> None:
    time.sleep(600)


def sleep(seconds: float, progress: Callable[[str, int, int | None], None]) -> None:
    progress(str(os.getpid()), 0, None)
    time.sleep(seconds)


def fail(kind: str) -> Any:
    class Odd(Exception):
        pass

    raise {"mesh": MeshError("no faces"), "value": ValueError("bad"), "odd": Odd("strange")}[kind]
