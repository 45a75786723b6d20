"""Laws of running code in a process of its own."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from refdgs_pipe.child_process import ChildCrashed, ChildTimeout, call_in_child
from refdgs_pipe.errors import Cancelled, MeshError

HERE = Path(__file__).parent
TARGETS = "child_targets"


@pytest.fixture(autouse=True)
def targets_can_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(HERE))


def is_running(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0]
    except FileNotFoundError:
        return False


def wait_until_gone(pid: int) -> None:
    deadline = time.monotonic() + 10
    while is_running(pid):
        assert time.monotonic() < deadline, f"process {pid} is still there"
        time.sleep(0.02)


def test_arrays_go_in_and_come_back() -> None:
    values = np.arange(5.0)
    assert np.array_equal(call_in_child(f"{TARGETS}:double", {"values": values}), values * 2)


def test_progress_is_passed_on_in_order() -> None:
    seen: list[tuple[str, int, int | None]] = []
    result = call_in_child(
        f"{TARGETS}:count", {"upto": 300}, on_progress=lambda *report: seen.append(report)
    )
    assert result == 300
    assert seen == [("counting", i + 1, 300) for i in range(300)]


def test_an_abort_is_an_error_with_the_signal_and_the_last_lines() -> None:
    with pytest.raises(ChildCrashed, match="SIGABRT") as caught:
        call_in_child(f"{TARGETS}:abort", {})
    text = str(caught.value)
    assert "said by C" in text
    assert "line 99" in text and "line 10\n" not in text


def test_a_kill_is_an_error_that_mentions_memory() -> None:
    with pytest.raises(ChildCrashed, match=r"SIGKILL.*memory"):
        call_in_child(f"{TARGETS}:kill_self", {})


def test_a_slow_child_is_stopped_in_time() -> None:
    start = time.monotonic()
    with pytest.raises(ChildTimeout, match=r"0\.5 s"):
        call_in_child(f"{TARGETS}:sleep", {"seconds": 60}, timeout_s=0.5)
    assert time.monotonic() - start < 20


def test_stop_ends_the_child() -> None:
    stop, pids = threading.Event(), []

    def note(label: str, done: int, total: int | None) -> None:
        pids.append(int(label))
        stop.set()

    with pytest.raises(Cancelled):
        call_in_child(f"{TARGETS}:sleep", {"seconds": 60}, stop=stop, on_progress=note)
    wait_until_gone(pids[0])


def test_users_errors_and_built_in_errors_come_back_as_themselves() -> None:
    with pytest.raises(MeshError, match="no faces"):
        call_in_child(f"{TARGETS}:fail", {"kind": "mesh"})
    with pytest.raises(ValueError, match="bad"):
        call_in_child(f"{TARGETS}:fail", {"kind": "value"})


def test_a_foreign_error_becomes_a_runtime_error_with_its_name() -> None:
    with pytest.raises(RuntimeError, match="Odd: strange") as caught:
        call_in_child(f"{TARGETS}:fail", {"kind": "odd"})
    assert "child_targets.py" in caught.value.__notes__[0]


@pytest.mark.skipif(sys.platform != "linux", reason="the kernel's parent-death signal is Linux's")
def test_the_child_dies_with_a_killed_parent() -> None:
    code = (
        "import os; from refdgs_pipe.child_process import call_in_child\n"
        f"call_in_child('{TARGETS}:sleep', {{'seconds': 60}},"
        " on_progress=lambda label, done, total: print(label, flush=True))"
    )
    paths = os.pathsep.join(path for path in sys.path if path)
    parent = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
    )
    assert parent.stdout is not None
    child = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_until_gone(child)
