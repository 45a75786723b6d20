"""What is wrong with workspaces, places and machines, in plain sentences and exit codes."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from shells import Shell

from refdgs_pipe.errors import (
    CorruptError,
    DiskFault,
    InputError,
    OutOfMemory,
    SystemLimit,
    WriteError,
)
from refdgs_pipe.formatting import printable, printable_lines
from refdgs_pipe.trouble import explained, is_memory


@pytest.fixture
def shell(tmp_path: Path) -> Shell:
    return Shell(tmp_path)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Shell:
    """A workspace that is made, for tests that change nothing in it; and a file."""
    shell = Shell(tmp_path_factory.mktemp("finished"))
    (shell.root / "file").write_text("x")
    shell("run", "letters", "-q")
    return shell


def test_photos_go_on_with_recipe_and_settings_of_their_workspace(shell: Shell) -> None:
    own = shell.root / "own.toml"
    own.write_text("[shout]\nmood = 'glad'\n")
    shell("run", "letters", "-w", "w", "--recipe", "own.toml", "--set", "shout.marks=2", "-q")
    said = shell("run", "letters", "-w", "w", "--set", "export.width=30")
    words = f"note: going on as the workspace was last run: --recipe {own} --set shout.marks=2. "
    assert words in said.stderr
    status = shell.json("status", "w")
    assert (Path(status["recipe"]).name, status["set"]) == (
        "own.toml",
        ["shout.marks=2", "export.width=30"],
    )
    assert {stage["state"] for stage in status["stages"]} == {"up to date"}
    shell("run", "letters", "-w", "w", "--set", "shout.marks=3", "-q")
    assert shell.json("status", "w")["set"] == ["export.width=30", "shout.marks=3"]
    shell("run", "letters", "-w", "w", "--recipe", "glossy", "-q")
    assert shell.json("status", "w")["set"] == []


def test_a_recipe_of_the_users_is_kept_with_all_that_it_builds_on(shell: Shell) -> None:
    (shell.root / "base.toml").write_text('# Base.\n[shout]\nmood = "a \'quoted\' \\"word\\""\n')
    own = shell.root / "mine.toml"
    own.write_text("# Loud.\nextends = 'base.toml'\ndraft = true\n[shout]\nmarks = 4\n")
    shell("run", "letters", "--recipe", "mine.toml", "-q")
    assert (shell.work / "asset" / "text").read_text().startswith("HELLO WORLD!!!!")
    own.unlink()
    (shell.root / "base.toml").unlink()
    assert shell.json("run", "letters.refdgs")["made"] == []
    assert shell.json("run", "letters")["made"] == []


def test_a_workspace_of_other_photos_is_refused(shell: Shell) -> None:
    shell("run", "letters", "-w", "w", "-q")
    other = shell.root / "other"
    other.mkdir()
    (other / "c.txt").write_text("another capture")
    said = shell("run", "other", "-w", "w", code=64).stderr
    assert "the workspace of other photos" in said and "Give another with -w" in said
    assert shell.json("status", "w")["photos"] == [str(shell.letters)]
    (other / "a.txt").write_text("hello")  # one of the same: photos were moved or added
    assert shell.json("run", "other", "-w", "w")["made"]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run", "letters", "-w", "letters"], 64, "the same folder. Give another with -w"),
        (["run", "/"], 64, "the root of the file system"),
        (["run", "letters", "-w", "/"], 64, "the root of the file system"),
        (["run", "letters.refdgs", "-w", "other"], 64, "a workspace, not photos"),
        (["run", "letters", "-w", "file"], 64, "a file, not a folder"),
        (["run", "letters", "-w", "file", "--dry-run"], 64, "a file, not a folder"),
        (["run", "letters", "-w", "file/w", "--dry-run"], 73, "cannot write here"),
        (["run", "letters", "--device", "tpu", "--dry-run"], 64, "expected auto, cpu, cuda"),
        (["run", "nowhere", "--device", "tpu"], 64, "expected auto, cpu, cuda"),
        (["run", "letters", "--device", "cuda", "--dry-run"], 71, "--device cuda"),
        (["run", "letters", "--from", "export", "--until", "read"], 64, "not made by --until read"),
        (["run", "letters", "--force", "export", "--until", "read"], 64, "nothing would be made"),
        (["run", "letters", "--from", "export", "--until", "read", "--dry-run"], 64, "not made by"),
        (["report", "letters.refdgs", "--out", "letters"], 64, "a folder. Give a file"),
        (["report", "letters.refdgs", "--out", "none/a.html"], 64, "no such folder"),
    ],
)
def test_what_cannot_be_meant_is_refused_before_anything_is_done(
    finished: Shell, arguments: list[str], code: int, words: str
) -> None:
    before = sorted(finished.root.rglob("*"))
    assert words in finished(*arguments, code=code).stderr
    assert sorted(finished.root.rglob("*")) == before


def test_a_workspace_given_as_itself_is_gone_on_with(shell: Shell) -> None:
    shell("run", "letters", "-q")
    assert shell.json("run", "letters.refdgs", "-w", "letters.refdgs")["made"] == []


@pytest.mark.parametrize(
    ("text", "commands"),
    [
        ("{", ("status", "run", "clean", "verify", "report", "path")),
        ("", ("status",)),
        ("[]", ("status",)),
        ("[" * 50_000, ("status",)),
        ('{"photos": [1], "recipe": 3}', ("status",)),
    ],
)
def test_a_damaged_workspace_note_is_named_and_photos_mend_it(
    shell: Shell, text: str, commands: tuple[str, ...]
) -> None:
    shell("run", "letters", "-q")
    (shell.work / "workspace.json").write_text(text)
    for command in commands:
        more = ["read"] if command == "path" else []
        said = shell(command, "letters.refdgs", *more, code=74).stderr
        assert "workspace.json: damaged" in said and "What is finished is kept" in said
    assert shell.json("run", "letters")["made"] == []
    shell("status", "letters.refdgs")


def test_a_workspace_of_a_newer_program_is_refused_by_name(shell: Shell) -> None:
    shell("run", "letters", "-q")
    note = shell.work / "workspace.json"
    record = json.loads(note.read_text())
    assert record["format"] == 1
    note.write_text(json.dumps(record | {"format": 2}))
    for arguments in (["status", "letters.refdgs"], ["run", "letters"]):
        said = shell(*arguments, code=64).stderr
        assert "a newer refdgs-pipe made this workspace (format 2" in said
    del record["format"]  # as workspaces of before there were formats have it
    note.write_text(json.dumps(record))
    assert shell.json("run", "letters")["made"] == []


def test_photos_that_are_gone_are_said_in_words(shell: Shell) -> None:
    shell("run", "letters", "-q")
    shutil.rmtree(shell.letters)
    for command in (["run", "letters.refdgs"], ["run", "letters"]):
        assert "letters: no such file or folder" in shell(*command, code=65).stderr


def test_names_that_are_no_utf_8_are_read_and_printed_as_they_are(shell: Shell) -> None:
    odd = os.fsdecode(b"caf\xe9")
    (shell.letters / f"{odd}.txt").write_text("odd name")
    folder = shell.root / odd
    shell.letters.rename(folder)
    process = subprocess.run(
        [sys.executable, *shell.command, "run", odd, "--json"],
        cwd=shell.root, capture_output=True, env=shell.environment, check=False,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    assert json.loads(process.stdout)["workspace"] == f"{folder}.refdgs"
    process = subprocess.run(
        [sys.executable, *shell.command, "run", odd],
        cwd=shell.root, capture_output=True, env=shell.environment, check=False,
    )  # fmt: skip
    assert process.stdout == os.fsencode(f"{folder}.refdgs/asset\n")
    shell("status", f"{odd}.refdgs")
    shell("verify", f"{odd}.refdgs")


def test_control_characters_of_names_reach_no_terminal_log_or_report(shell: Shell) -> None:
    evil = "a\x1b]0;owned\x07\x1b[31m\u202egpj.txt"
    (shell.root / evil).write_text("MINE")
    shell("run", "letters", "-q")
    said = [shell("adopt", "letters.refdgs", "shout", evil).stdout]
    ran = shell("run", "letters.refdgs", "-v")
    said += [ran.stdout, ran.stderr, shell("status", "letters.refdgs").stdout]
    said.append(shell("path", f"{evil}.refdgs", "x", code=64).stderr)
    said.append((shell.work / "report.html").read_text())
    said += [path.read_text() for path in (shell.work / "logs").iterdir()]
    for text in said:
        assert not {"\x1b", "\x07", "\u202e"} & set(text)
    assert "\\x1b]0;owned" in said[0]


def test_printable_shows_what_would_steer_a_terminal() -> None:
    assert printable("Kanne ä 茶.jpg") == "Kanne ä 茶.jpg"
    assert printable("a\x1b[2J\nb\x9b\u202e\x7f") == "a\\x1b[2J\\x0ab\\x9b\\u202e\\x7f"
    assert printable(os.fsdecode(b"a\xff")) == "a\\xff"
    assert printable_lines("a\n\tb\r") == "a\n\tb\\x0d"


def test_a_byte_that_was_changed_is_served_by_no_command(shell: Shell) -> None:
    shell("run", "letters", "-q")
    path = Path(shell("path", "letters.refdgs", "shout").stdout.strip()) / "text"
    path.write_bytes(b"x" * path.stat().st_size)
    said = shell("path", "letters.refdgs", "shout", code=74).stderr
    assert "content was changed" in said and "verify" in said


def test_verify_finds_sets_aside_and_run_makes_again(shell: Shell) -> None:
    shell("run", "letters", "-q")
    proof = shell.json("verify", "letters.refdgs")
    assert proof["sound"] and proof["complete"] and proof["checked"] == 3
    chain = {link["stage"]: link for link in proof["chain"]}
    assert chain["read"]["inputs"] == {"letters": proof["capture"]}
    assert chain["shout"]["inputs"] == {"words": chain["read"]["digest"]}
    assert chain["export"]["inputs"]["shout"] == chain["shout"]["digest"]
    assert proof["asset_files"] == chain["export"]["files"]
    path = Path(shell("path", "letters.refdgs", "shout").stdout.strip())
    whole = (path / "text").read_bytes()
    (path / "text").write_bytes(b"x" * len(whole))
    asset = shell.work / "asset" / "text"
    asset.write_bytes(b"x" * asset.stat().st_size)
    said = shell("verify", "letters.refdgs", code=74).stdout
    assert "content was changed" in said and "set aside" in said
    assert (path.with_name(f".damaged-{path.name}") / "text").read_bytes() != whole
    assert shell.json("run", "letters")["made"] == ["shout"]
    assert (path / "text").read_bytes() == whole
    assert shell.json("verify", "letters.refdgs")["sound"]


def test_a_run_can_verify_first(shell: Shell) -> None:
    shell("run", "letters", "-q")
    path = Path(shell("path", "letters.refdgs", "read").stdout.strip()) / "parts" / "0.bin"
    path.write_bytes(b"x" * path.stat().st_size)
    assert shell.json("run", "letters")["made"] == []  # nothing reads it
    process = shell("run", "letters", "--verify", "--json")
    assert json.loads(process.stdout)["made"] == ["read"]
    assert "3 results compared byte for byte, 1 damaged" in process.stderr


def test_verify_finds_a_photo_whose_times_were_set_back(shell: Shell) -> None:
    old = time.time() - 1000
    os.utime(shell.letters / "a.txt", (old, old))
    shell("run", "letters", "-q")
    memory = shell.work / ".source.json"
    (shell.letters / "a.txt").write_text("HELLO")
    os.utime(shell.letters / "a.txt", (old, old))
    facts = (shell.letters / "a.txt").stat()
    record = json.loads(memory.read_text()) if memory.exists() else {"files": {}}
    from refdgs_pipe.pipeline.fingerprint import hash_path

    (shell.root / "before").write_text("hello")
    known = [facts.st_size, facts.st_mtime_ns, facts.st_ctime_ns, hash_path(shell.root / "before")]
    record["files"]["a.txt"] = known
    memory.write_text(json.dumps(record))
    assert shell.json("status", "letters.refdgs")["stages"][0]["state"] == "up to date"
    proof = shell.json("verify", "letters.refdgs")
    assert proof["open"]["read"] == "new letters (1 of 2 files changed)"


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (MemoryError(), OutOfMemory),
        (OSError(errno.ENOMEM, "x"), OutOfMemory),
        (RuntimeError("DefaultCPUAllocator: not enough memory: you tried to"), OutOfMemory),
        (RuntimeError("std::bad_alloc"), OutOfMemory),
        (ImportError("_rawpy.so: failed to map segment from shared object"), OutOfMemory),
        (OSError(errno.EIO, "x", "a.jpg"), DiskFault),
        (OSError(errno.ESTALE, "x", "a.jpg"), DiskFault),
        (OSError(errno.ENOLCK, "x", "a"), SystemLimit),
        (OSError(errno.EMFILE, "x", "a"), SystemLimit),
        (OSError(errno.ENOSPC, "x", "a"), WriteError),
        (OSError(errno.EDQUOT, "x", "a"), WriteError),
        (OSError(errno.EACCES, "x", "a"), WriteError),
        (OSError(errno.ENAMETOOLONG, "x", "a"), InputError),
        (UnicodeEncodeError("utf-8", "a\udcff", 1, 2, "x"), InputError),
        (CorruptError("x"), CorruptError),
    ],
)
def test_failures_of_the_machine_have_words_and_codes_of_their_own(
    error: Exception, kind: type[Exception]
) -> None:
    found = explained(error)
    assert type(found) is kind and found.exit_code != 70


def test_what_no_machine_is_to_blame_for_is_a_bug() -> None:
    assert explained(KeyError("x")) is None and explained(OSError("x")) is None
    assert not is_memory(InputError("--memory: not enough memory"))


@pytest.mark.parametrize(("number", "code"), [(errno.EIO, 77), (errno.ENOLCK, 78), (0, 76)])
def test_each_failure_of_the_machine_ends_a_run_with_its_code(
    shell: Shell, number: int, code: int
) -> None:
    (shell.letters / "c.txt").write_text(f"fail {number}")
    said = shell("run", "letters", code=code).stderr
    assert "mistake of ours" not in said
    assert "internal" not in said


def test_ctrl_c_while_importing_is_no_traceback(shell: Shell) -> None:
    code = (
        "import sys, os, signal\n"
        "class Slow:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name == 'refdgs_pipe.cli.app':\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Slow())\n"
        "from refdgs_pipe.__main__ import main\n"
        "main()\n"
    )
    process = subprocess.run(
        [sys.executable, "-c", code, "--help"],
        capture_output=True, text=True, env=shell.environment, check=False,
    )  # fmt: skip
    assert (process.returncode, process.stderr) == (130, "stopped before anything was done\n")


def test_ctrl_c_before_the_first_stage_is_no_traceback(shell: Shell) -> None:
    letter = shell.letters / "c.txt"
    os.mkfifo(letter)  # reading it waits
    process = shell.start("run", "letters", "--dry-run")
    nothing = writer_of(letter)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=20)
    os.close(nothing)
    assert process.returncode == 130
    assert said.strip().endswith("What is finished is kept; run again to go on")


def writer_of(pipe: Path) -> int:
    """A handle that writes to a named pipe, once somebody reads it."""
    deadline = time.monotonic() + 20
    while True:
        try:
            return os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError as error:
            assert error.errno == errno.ENXIO and time.monotonic() < deadline
            time.sleep(0.02)
