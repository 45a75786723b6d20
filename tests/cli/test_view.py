"""`view` and `run --view`: what is refused, and that a view changes nothing about a run."""

import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from shells import FAKE_CLI, Shell

from refdgs_pipe.cli.companion import Companion
from refdgs_pipe.cli.memory import Memory
from refdgs_pipe.cli.view import remember
from refdgs_pipe.cli.workspace import open_workspace
from refdgs_pipe.pipeline.store import Store


@pytest.fixture
def shell(tmp_path: Path) -> Shell:
    return Shell(tmp_path)


def without_viser(shell: Shell) -> dict[str, str]:
    """An environment in which viser cannot be found."""
    hidden = shell.root / "hidden"
    hidden.mkdir()
    code = (
        "import sys\n"
        "class Hide:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'viser':\n"
        "            raise ModuleNotFoundError(name)\n"
        "sys.meta_path.insert(0, Hide())\n"
        "import importlib.util as u\n"
        "plain = u.find_spec\n"
        "u.find_spec = lambda n, p=None: None if n == 'viser' else plain(n, p)\n"
    )
    (hidden / "sitecustomize.py").write_text(code)
    return {"PYTHONPATH": os.pathsep.join([str(hidden), shell.environment["PYTHONPATH"]])}


def test_without_viser_the_message_says_what_to_install(shell: Shell) -> None:
    shell("run", "letters", "-q")
    hidden = without_viser(shell)
    for arguments in (["view", "letters.refdgs"], ["run", "letters", "--view"]):
        said = shell(*arguments, code=64, **hidden).stderr
        assert "pip install 'refdgs-pipe[view]'" in said


def test_what_is_no_workspace_is_refused(shell: Shell) -> None:
    (shell.root / "empty").mkdir()
    for name in ("nowhere", "empty", "letters"):
        assert "not a workspace" in shell("view", name, code=64).stderr


def test_a_workspace_of_a_newer_version_is_refused(shell: Shell) -> None:
    shell("run", "letters", "-q")
    path = shell.work / "workspace.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": 99}))
    assert "newer refdgs-pipe" in shell("view", "letters.refdgs", code=64).stderr


def test_a_run_with_a_view_ends_as_one_without(shell: Shell) -> None:
    pytest.importorskip("viser")
    result = shell("run", "letters", "--view")
    assert result.stdout == f"{shell.work / 'asset'}\n"
    assert result.stderr.startswith("view: http://127.0.0.1:")
    assert "warning" not in result.stderr


def test_at_a_terminal_the_view_stays_until_ctrl_c_and_the_run_has_gone_well(shell: Shell) -> None:
    pytest.importorskip("viser")
    master, slave = pty.openpty()
    command = [sys.executable, str(FAKE_CLI), "run", "letters", "--view"]
    process = subprocess.Popen(
        command,
        cwd=shell.root,
        env=shell.environment,
        stdin=slave,
        stderr=slave,
        stdout=subprocess.PIPE,
        text=True,
    )
    os.close(slave)
    said = b""  # a read may end within a letter
    while b"view: still at http://127.0.0.1:" not in said:
        said += os.read(master, 1000)
    assert process.poll() is None
    child = _child_of(process.pid)
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    os.close(master)
    assert (process.returncode, out) == (0, f"{shell.work / 'asset'}\n")
    assert not _command(child)


def test_a_view_that_is_killed_changes_nothing_about_the_run(shell: Shell) -> None:
    pytest.importorskip("viser")
    process = shell.start("run", "letters", "--view", "--json", "--strict", FAKE_STEP_S="0.2")
    child = _child_of(process.pid)
    os.kill(child, signal.SIGKILL)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert json.loads(out)["status"] == "ok"
    assert err.count("warning: the view ended (exit code -9)") == 1


def test_a_view_ends_with_a_run_that_is_killed(shell: Shell) -> None:
    pytest.importorskip("viser")
    process = shell.start("run", "letters", "--view", FAKE_STEP_S="1")
    child = _child_of(process.pid)
    process.kill()
    process.wait()
    end = time.monotonic() + 60
    while Path(f"/proc/{child}/cmdline").exists() and _command(child):
        assert time.monotonic() < end
        time.sleep(0.1)


def test_a_view_that_fails_gives_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    program = "import sys; print('first', file=sys.stderr); sys.exit('error: no port')"
    companion = Companion([sys.executable, "-c", program], again="again")
    companion.process.wait()
    companion.end()
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1
    assert "exit code 1): error: no port. The run goes on" in lines[0]


def test_a_view_that_is_told_to_end_gives_no_warning(capfd: pytest.CaptureFixture[str]) -> None:
    companion = Companion([sys.executable, "-c", "import time; time.sleep(99)"], again="again")
    companion.end()
    assert companion.process.returncode == -signal.SIGTERM
    assert capfd.readouterr().err == ""


def workspace(root: Path) -> Path:
    """One that remembers a setting."""
    photos, work = root / "photos", root / "work"
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"\xff\xd8")
    work.mkdir()
    Memory((photos,), "preview", ("gate.up=[0, 0, 1]", "train.iterations=9")).write(work)
    return work


def test_a_choice_is_remembered_as_a_setting_is(tmp_path: Path) -> None:
    work = workspace(tmp_path)
    said = remember(work, ["gate.up=[0, 1, 0]", "gate.ball_radius=0.5"])
    assert said.startswith("Remembered.")
    settings = open_workspace(work).settings["gate"].model_dump()
    assert (settings["up"], settings["ball_radius"]) == ((0, 1, 0), 0.5)
    assert "train.iterations=9" in Memory.read(work).assignments


def test_nothing_is_remembered_while_a_run_goes_on(tmp_path: Path) -> None:
    work, said = workspace(tmp_path), list[str]()
    before = Memory.read(work)
    with Store(work).lock():
        thread = threading.Thread(target=lambda: said.append(remember(work, ["gate.up=[1, 0, 0]"])))
        thread.start()
        thread.join()
    assert said[0].startswith("A run goes on here.")
    assert Memory.read(work) == before


def test_a_choice_that_cannot_be_is_not_remembered(tmp_path: Path) -> None:
    work = workspace(tmp_path)
    before = Memory.read(work)
    assert remember(work, ["gate.ball_radius=-1"]).startswith("Not remembered: ")
    assert Memory.read(work) == before


def _child_of(parent: int) -> int:
    """The view that a run started."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        for path in Path(f"/proc/{parent}/task/{parent}").glob("children"):
            for number in map(int, path.read_text().split()):
                if b"--with-run" in _command(number):
                    return number
        time.sleep(0.02)
    raise AssertionError("no view was started")


def _command(process: int) -> bytes:
    try:
        return Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return b""
