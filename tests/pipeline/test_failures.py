"""What a full disk, a second process or a kill cannot do: lose or falsify a result."""

import errno
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_stages import STAGES, Letters, PrintParams, ReadParams, ShoutParams
from forking import Forked

from refdgs_pipe.errors import WorkspaceBusy, WriteError
from refdgs_pipe.pipeline import atomic
from refdgs_pipe.pipeline.events import Event, Started
from refdgs_pipe.pipeline.plan import Pipeline
from refdgs_pipe.pipeline.runner import Request, run
from refdgs_pipe.pipeline.store import MANIFEST, Manifest, Store, check_contents

FAKE_CLI = Path(__file__).parent.parent / "fake_cli.py"
SETTINGS = {"read": ReadParams(), "shout": ShoutParams(), "export": PrintParams()}


@pytest.fixture
def letters(tmp_path: Path) -> Path:
    folder = tmp_path / "letters"
    folder.mkdir()
    (folder / "a.txt").write_text("one two three four five")
    return folder


def start(*arguments: str, step_s: float = 0.0) -> Forked:
    return Forked([str(FAKE_CLI), *arguments], None, os.environ | {"FAKE_STEP_S": str(step_s)})


def make(letters: Path, work: Path) -> list[Event]:
    log: list[Event] = []
    pipeline = Pipeline(Letters, STAGES, Store(work))
    request = Request(publish={"export": "asset"})
    run(pipeline, Letters((letters,)), SETTINGS, log.append, request)
    return log


def content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def assert_whole(work: Path) -> int:
    """Every visible result is complete and as its manifest says; so is the asset."""
    folders = [path for path in work.glob("*/[!.]*") if path.parent.name in SETTINGS]
    for folder in folders:
        check_contents(folder, Manifest.read(folder))
    asset = content(work / "asset")
    if asset:
        pages = [content(folder) for folder in (work / "export").glob("[!.]*")]
        for page in pages:
            del page[MANIFEST]
        assert asset in pages
    return len(folders)


def test_killed_at_50_random_moments_the_next_run_ends_with_the_same_result(
    letters: Path, tmp_path: Path
) -> None:
    undisturbed, work = tmp_path / "undisturbed", tmp_path / "work"
    make(letters, undisturbed)
    chance = random.Random(0)
    for _ in range(50):
        marks = chance.choice((1, 2))
        process = start(
            *("run", str(letters), "-w", str(work), "--set", f"shout.marks={marks}", "--from"),
            chance.choice(("read", "shout", "export")),
            step_s=0.005,
        )
        time.sleep(chance.random() * 0.25)  # a run takes about that long
        process.send_signal(signal.SIGKILL)
        process.communicate()
        if work.exists():
            assert_whole(work)
    make(letters, work)
    assert content(work / "asset") == content(undisturbed / "asset")
    assert assert_whole(work) >= 3
    assert not list(work.glob("*/.partial-*"))


@pytest.mark.parametrize("can_exchange", [True, False])
def test_killed_at_every_step_on_disk_a_run_leaves_old_or_new(
    letters: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, can_exchange: bool
) -> None:
    """Stop before the n-th change on disk and look at what a reader would see.

    Even n where the system can exchange two folders, odd n where it cannot: half the time.
    """

    class Killed(BaseException):
        pass

    if not can_exchange:
        monkeypatch.setattr(atomic, "_exchange", lambda one, other: False)
    make(letters, tmp_path / "undisturbed")
    steps = 0
    for steps in range(0 if can_exchange else 1, 400, 2):
        work = tmp_path / f"work{steps}"
        left = steps
        with monkeypatch.context() as patch:

            def tick(real: Any) -> Any:
                def stepping(*arguments: Any, **named: Any) -> Any:
                    nonlocal left
                    if left == 0:
                        raise Killed
                    left -= 1
                    return real(*arguments, **named)

                return stepping

            patch.setattr(os, "fsync", tick(lambda handle: None))  # the real one takes long
            for name in ("rename", "replace", "unlink", "mkdir", "write_bytes"):
                patch.setattr(Path, name, tick(getattr(Path, name)))
            try:
                make(letters, work)
                make_loud(letters, work)
            except Killed:
                pass
            else:
                break
        assert_whole(work) if work.exists() else None
        make(letters, work)
        assert content(work / "asset") == content(tmp_path / "undisturbed" / "asset")
        shutil.rmtree(work)
    assert 50 < steps < 398


def make_loud(letters: Path, work: Path) -> None:
    settings = SETTINGS | {"shout": ShoutParams(marks=2)}
    pipeline = Pipeline(Letters, STAGES, Store(work))
    request = Request(publish={"export": "asset"}, force=frozenset({"read"}))
    run(pipeline, Letters((letters,)), settings, lambda event: None, request)


def test_a_second_process_is_refused_and_the_lock_dies_with_its_owner(
    letters: Path, tmp_path: Path
) -> None:
    work = tmp_path / "work"
    first = start("run", str(letters), "-w", str(work), step_s=5)
    wait_for(work / "shout")
    second = start("run", str(letters), "-w", str(work))
    _, said = second.communicate()
    assert second.returncode == WorkspaceBusy.exit_code
    assert f"process {first.pid} is working here" in said
    assert "Traceback" not in said
    first.kill()
    first.communicate()
    assert [e.stage for e in make(letters, work) if isinstance(e, Started)] == ["shout", "export"]


def test_status_works_while_another_process_runs(letters: Path, tmp_path: Path) -> None:
    work = tmp_path / "work"
    first = start("run", str(letters), "-w", str(work), step_s=5)
    wait_for(work / "shout")
    said, _ = start("status", str(work)).communicate()
    assert said.splitlines()[0].startswith("running: shout")
    assert said.splitlines()[1].startswith("read    up to date")
    first.kill()
    first.communicate()


@pytest.fixture
def tiny_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 2 MiB."""
    place = tmp_path / "tiny"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=2m", "none", str(place)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("mounting a small file system needs root")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk_is_said_in_words_and_loses_nothing(letters: Path, tiny_disk: Path) -> None:
    work = tiny_disk / "work"
    make(letters, work)
    before = content(work)
    filler = tiny_disk / "filler"
    filler.write_bytes(b"x" * (1 << 20))
    with pytest.raises(OSError), filler.open("ab") as file:
        while True:
            file.write(b"x" * 4096)
            file.flush()
    with pytest.raises(WriteError, match="no space left"):
        make_loud(letters, work)
    assert_whole(work)
    assert {k: v for k, v in content(work).items() if k in before and k[0] != "."} == {
        k: v for k, v in before.items() if k[0] != "."
    }
    filler.unlink()
    assert [e for e in make(letters, work) if isinstance(e, Started)] == []


@pytest.mark.parametrize("name", ["write_text", "write_bytes"])
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_each_way_of_not_writing_is_said_in_words(
    letters: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, number: int
) -> None:
    work = tmp_path / "work"
    make(letters, work)

    def refuse(path: Path, *arguments: object, **named: object) -> None:
        raise OSError(number, os.strerror(number), str(path))

    with monkeypatch.context() as patch:
        patch.setattr(Path, name, refuse)
        with pytest.raises(WriteError):
            make_loud(letters, work)
    assert_whole(work)
    assert [e for e in make(letters, work) if isinstance(e, Started)] == []


def test_a_workspace_that_cannot_be_made_is_said_in_words(letters: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(WriteError, match="cannot write here"):
        make(letters, tmp_path / "file" / "work")
    with pytest.raises(WriteError, match="cannot write here"):
        make(letters, tmp_path / "file")


def wait_for(path: Path) -> None:
    deadline = time.monotonic() + 20
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} did not appear"
        time.sleep(0.02)
