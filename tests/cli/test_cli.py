"""The command line, over small stages: what it prints, where, and how it ends."""

import json
import re
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from shells import Shell

from refdgs_pipe.cli.workspace import Memory, open_workspace


@pytest.fixture
def shell(tmp_path: Path) -> Shell:
    return Shell(tmp_path)


def test_run_prints_the_asset_on_stdout_and_the_rest_on_stderr(shell: Shell) -> None:
    result = shell("run", "letters")
    assert result.stdout == f"{shell.work / 'asset'}\n"
    assert (shell.work / "asset" / "text").read_text() == "HELLO WORLD! (hello world) 20.0"
    lines = [re.sub(r"[\d.]+ s", "T", line) for line in result.stderr.splitlines()]
    assert lines.pop() == f"report: {shell.work / 'report.html'}"
    assert lines == [
        "read: running",
        "read: done in T",
        "shout: running",
        "shout: done in T",
        "export: writing the files",
        "export: done in T",
        "report: drawing the report",
        "",
        f"the asset is in {shell.work / 'asset'}",
        "  parts/0.bin  5.0 kB",
        "  parts/1.bin  6.0 kB",
        "  parts/2.bin  6.0 kB",
        "  3 more       10.0 kB",
        "time:",
        "  read    T",
        "  shout   T",
        "  export  T",
        "  report  T",
        "finished in T",
    ]


def test_a_second_run_says_that_everything_is_up_to_date(shell: Shell) -> None:
    shell("run", "letters", "-q")
    said = shell("run", "letters").stderr
    assert said.splitlines()[:3] == ["read: up to date", "shout: up to date", "export: up to date"]
    assert "finished, everything was up to date" in said


def test_options_work_before_and_after_the_photos(shell: Shell) -> None:
    shell("run", "--quiet", "--set", "shout.marks=2", "letters")
    assert shell.json("run", "letters", "--set", "shout.marks=2")["made"] == []


def test_json_is_one_object(shell: Shell) -> None:
    record = shell.json("run", "letters")
    assert record["status"] == "ok"
    assert record["made"] == ["read", "shout", "export"]
    assert record["files"]["text"] == 31
    assert record["stages"][2]["measures"] == {"faces": 12}
    assert Path(record["stages"][0]["folder"]).is_dir()


def test_warnings_make_a_result_degraded_and_strict_makes_that_an_error(shell: Shell) -> None:
    (shell.letters / "c.txt").write_text("odd")
    assert shell.json("run", "letters")["status"] == "degraded"
    assert shell.json("run", "letters", "--strict", code=3)["warnings"] == ["an odd letter"]
    assert "warning: an odd letter" in shell("status", "letters.refdgs").stdout


def test_the_workspace_remembers_photos_recipe_and_settings(shell: Shell) -> None:
    shell("run", "letters", "--set", "shout.marks=2", "-w", "elsewhere")
    assert shell.json("rerun", "elsewhere", "shout")["made"] == ["shout"]
    status = shell.json("status", "elsewhere")
    assert (status["recipe"], status["set"]) == ("glossy", ["shout.marks=2"])
    assert {stage["state"] for stage in status["stages"]} == {"up to date"}
    assert shell.json("run", "elsewhere", "--set", "export.width=30")["made"] == ["export"]


def test_status_says_why_and_tries_settings_out(shell: Shell) -> None:
    shell("run", "letters", "-q")
    said = shell("status", "letters.refdgs", "--set", "shout.marks=3").stdout
    assert [line.split(maxsplit=2) for line in said.splitlines()[1:]] == [
        ["shout", "stale", "marks 1 -> 3"],
        ["export", "waiting", "waits for shout"],
    ]
    assert (
        len(
            {
                line.index(word)
                for line, word in zip(said.splitlines()[1:], ("marks", "waits"), strict=True)
            }
        )
        == 1
    )
    assert "stale" not in shell("status", "letters.refdgs").stdout


def test_status_of_a_workspace_that_is_worked_in_says_running(shell: Shell) -> None:
    process = shell.start("run", "letters", FAKE_STEP_S="5")
    try:
        while "shouting" not in "".join(p.read_text() for p in shell.work.glob("logs/*")):
            time.sleep(0.05)
        said = shell("status", "letters.refdgs").stdout.splitlines()
        running = shell.json("status", "letters.refdgs")["running"]
    finally:
        process.kill()
        process.communicate()
    assert said[0].startswith("running: shout, shouting ")
    assert [line.split()[:2] for line in said if line.startswith("shout")] == [["shout", "running"]]
    assert (running["stage"], running["label"], running["total"]) == ("shout", "shouting", 10)
    assert shell.json("status", "letters.refdgs")["running"] is None


def test_a_short_option_asks_for_help_too(shell: Shell) -> None:
    assert shell("-h").stdout == shell("--help").stdout
    assert shell("recipe", "list", "-h").stdout.startswith("Usage: refdgs-pipe recipe list")


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("run p --recipe prev", "preview"),
        ("run p --device cu", "cuda"),
        ("run p --until sh", "shout"),
        ("rerun w ex", "export"),
        ("run p --set shout.m", "shout.marks="),
        ("bench a --recipes glossy,mat", "glossy,matte"),
    ],
)
def test_tab_offers_recipes_stages_settings_and_devices(
    words: str, offered: str, shell: Shell
) -> None:
    said = shell(
        _REFDGS_PIPE_COMPLETE="complete_zsh", _TYPER_COMPLETE_ARGS=f"refdgs-pipe {words}"
    ).stdout
    assert f'"{offered}"' in said.replace("\\", "")


def test_a_dry_run_makes_nothing(shell: Shell) -> None:
    said = shell("run", "letters", "--dry-run").stdout
    assert said.splitlines()[0] == "read    never run"
    assert not shell.work.exists()
    shell("run", "letters", "-q")
    said = shell("run", "letters", "--dry-run", "--from", "shout").stdout
    assert said.splitlines() == [
        "read    up to date",
        "shout   asked for again",
        "export  asked for again",
    ]


def test_from_force_and_until(shell: Shell) -> None:
    assert shell.json("run", "letters", "--until", "shout")["made"] == ["read", "shout"]
    shell("run", "letters", "-q")
    assert shell.json("run", "letters", "--force", "read")["made"] == ["read"]
    assert shell.json("run", "letters", "--from", "shout")["made"] == ["shout", "export"]
    assert shell.json("run", "letters", "--from", "shout", "--until", "shout")["made"] == ["shout"]


def test_path_prints_the_folder_of_a_result(shell: Shell) -> None:
    shell("run", "letters", "-q")
    folder = Path(shell("path", "letters.refdgs", "shout").stdout.strip())
    assert (folder / "text").read_text() == "HELLO WORLD!"
    assert shell("path", "letters.refdgs", "Shout").stdout.strip() == str(folder)
    (shell.letters / "a.txt").write_text("bye")
    said = shell("path", "letters.refdgs", "shout", code=64).stderr
    assert said == "error: shout has no current result: waits for read. Make it with `run`\n"


def test_results_can_be_looked_at_when_the_photos_are_gone(shell: Shell) -> None:
    shell("run", "letters", "-q")
    shell.letters.rename(shell.root / "archive")
    assert "stale" not in shell("status", "letters.refdgs").stdout
    assert shell("path", "letters.refdgs", "shout").stdout
    assert "no such file or folder" in shell("rerun", "letters.refdgs", "read", code=65).stderr


def test_photos_and_workspace_may_move_together(shell: Shell) -> None:
    shell("run", "letters", "-q")
    moved = shell.root / "other" / "place"
    moved.mkdir(parents=True)
    shell.letters.rename(moved / "letters")
    shell.work.rename(moved / "letters.refdgs")
    shell.root = moved
    assert shell.json("run", "letters.refdgs")["made"] == []
    assert shell.json("run", "letters")["made"] == []


def test_adopt_and_drop(shell: Shell) -> None:
    shell("run", "letters", "-q")
    (shell.root / "mine.txt").write_text("MINE")
    assert "adopted from mine.txt" in shell("adopt", "letters.refdgs", "shout", "mine.txt").stdout
    assert shell.json("run", "letters")["made"] == ["export"]
    said = shell("status", "letters.refdgs").stdout.splitlines()[1]
    assert said.split(maxsplit=2) == ["shout", "adopted", "from mine.txt"]
    assert "its own result again" in shell("adopt", "letters.refdgs", "shout", "--drop").stdout
    assert shell.json("run", "letters")["made"] == []
    assert "give a file, or --drop" in shell("adopt", "letters.refdgs", "shout", code=64).stderr


def test_clean_frees_old_results(shell: Shell) -> None:
    shell("run", "letters", "-q")
    shell("run", "letters", "-q", "--set", "shout.marks=2")
    unused = shell.json("clean", "letters.refdgs", "--dry-run")["unused"]
    assert len(unused) == 2
    assert len(shell.json("clean", "letters.refdgs")["deleted"]) == 2
    assert not any(Path(path).exists() for path in unused)
    assert shell.json("run", "letters", "--set", "shout.marks=2")["made"] == []


def test_an_option_of_the_run_reaches_the_stages_and_changes_no_key(shell: Shell) -> None:
    shell("run", "letters", "--cuda-graph", "-q")
    shout = shell.json("run", "letters", "--no-cuda-graph")
    assert shout["made"] == []
    assert shout["stages"][1]["measures"]["recorded"] == "True"
    record = shell.json("rerun", "letters.refdgs", "shout", "--no-cuda-graph")
    assert record["stages"][1]["measures"]["recorded"] == "False"


def test_a_setting_that_is_an_option_now_is_named_and_the_workspace_opens(shell: Shell) -> None:
    (shell.root / "mine.toml").write_text("[shout]\nmarks = 2\nvolume = 'high'\n")
    shell("run", "letters", "--recipe", "mine.toml", "-q")
    note = shell.work / "workspace.json"
    record = json.loads(note.read_text())
    note.write_text(json.dumps(record | {"set": ["shout.volume=low", "shout.mood=glad"]}))
    said = shell("status", "letters.refdgs").stderr
    words = "note: --set shout.volume=low: shout.volume is now the option --cuda-graph, and is"
    assert words in said
    said = shell("run", "letters.refdgs", "-q").stderr
    assert words in said
    assert json.loads(note.read_text())["set"] == ["shout.mood=glad"]
    note.write_text(json.dumps(record))
    said = shell("status", "letters.refdgs").stderr
    assert said == (
        f"note: {shell.root / 'mine.toml'}: shout.volume is now the option --cuda-graph, "
        "and is ignored here\n"
    )


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run", "nowhere"], 65, "nowhere: no such file or folder"),
        (["run", "empty"], 65, "nothing in it"),
        (["run", "letters", "--recipe", "glosy"], 64, "Did you mean glossy?"),
        (["run", "letters", "--recipe", "mine.toml"], 64, "mine.toml: cannot read"),
        (["run", "letters", "--set", "shout.marks"], 64, "expected stage.setting=value"),
        (["run", "letters", "--set", "shuot.marks=1"], 64, "Did you mean shout?"),
        (["run", "letters", "--set", "shout.mark=1"], 64, "Did you mean shout.marks?"),
        (["run", "letters", "--set", "shout.marks=many"], 64, 'shout.marks = "many": expected'),
        (["run", "letters", "--set", "shout.marks=10"], 64, "less than or equal to 9"),
        (["run", "letters", "--set", "shout.marks=10", "--dry-run"], 64, "less than or equal to 9"),
        (["run", "letters", "--until", "shot"], 64, "no stage is called 'shot'"),
        (["run", "letters", "--device", "tpu"], 64, "expected auto, cpu, cuda"),
        (["run", "letters", "--vram", "lots"], 64, "expected an amount such as 8GB"),
        (["run", "letters", "--set", "shout.mood=mute"], 68, "no voice. Set shout.mood"),
        (["status", "letters"], 64, "not a workspace"),
        (["run"], 2, "Missing argument"),
        (["run", "letters", "--nonsense"], 2, "No such option"),
    ],
)
def test_mistakes_end_in_one_message_and_their_exit_code(
    shell: Shell, arguments: list[str], code: int, words: str
) -> None:
    (shell.root / "empty").mkdir()
    result = shell(*arguments, code=code)
    assert words in result.stderr
    assert result.stdout == ""


def test_an_error_with_json_is_an_object_too(shell: Shell) -> None:
    record = shell.json("run", "nowhere", code=65)
    assert (record["status"], record["kind"], record["exit_code"]) == ("failed", "CaptureError", 65)


def test_a_mistake_of_ours_is_one_line_and_a_log(shell: Shell) -> None:
    (shell.letters / "a.txt").write_text("bug")
    said = shell("run", "letters", "-q", code=70).stderr
    log = Path(said.split()[-1])
    assert log.parent == shell.work / "logs" and "KeyError" in said
    last = json.loads(log.read_text().splitlines()[-1])
    assert last["event"] == "failed" and "Traceback" in last["traceback"]


def test_the_log_has_every_event_as_json(shell: Shell) -> None:
    shell("run", "letters", "-q")
    (log,) = (shell.work / "logs").glob("*.jsonl")
    events = [json.loads(line) for line in log.read_text().splitlines()]
    assert events[0]["settings"]["shout"] == {"marks": 1, "mood": "calm"}
    assert [e["stage"] for e in events if e["event"] == "finished"] == ["read", "shout", "export"]


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_a_signal_stops_the_run_and_the_next_one_resumes(
    shell: Shell, number: int, code: int
) -> None:
    process = shell.start("run", "letters", FAKE_STEP_S="0.2")
    wait_for_checkpoint(shell)
    process.send_signal(number)
    _, said = process.communicate(timeout=20)
    assert process.returncode == code
    assert "stopping at the next safe point" in said
    assert said.endswith("What is finished is kept; run again to go on\n")
    record = shell.json("run", "letters")
    assert record["made"] == ["shout", "export"]
    assert record["stages"][1]["measures"]["resumed at"] >= 1


def test_ctrl_c_twice_ends_the_process_at_once(shell: Shell) -> None:
    process = shell.start("run", "letters", FAKE_STEP_S="30")
    deadline = time.monotonic() + 20
    while not list(shell.work.glob("shout/.scratch-*")):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    time.sleep(0.3)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=5)
    assert process.returncode == 130
    assert shell.json("run", "letters")["made"] == ["shout", "export"]


def test_recipes_are_listed_and_shown(shell: Shell) -> None:
    lines = shell("recipe", "list").stdout.splitlines()
    assert lines[0].startswith("glossy ")
    assert {line.split()[0] for line in lines} >= {"glossy", "matte", "preview"}


def test_nothing_is_colored_without_a_terminal(shell: Shell) -> None:
    result = shell("run", "letters")
    assert "\x1b" not in result.stdout + result.stderr


def wait_for_checkpoint(shell: Shell) -> None:
    deadline = time.monotonic() + 20
    while not list(shell.work.glob("shout/.scratch-*/done")):
        assert time.monotonic() < deadline, "no checkpoint appeared"
        time.sleep(0.02)


def test_every_run_ends_with_a_report_of_what_is_there(shell: Shell) -> None:
    record = shell.json("run", "letters")
    page = shell.work / "report.html"
    assert record["report"] == str(page)
    text = page.read_text()
    assert "<h1>letters</h1>" in text and 'class="verdict unjudged"' in text
    assert "Nothing yet: to be made by" in text  # this pipeline has no photos, cameras or meshes
    assert str(shell.root) not in text.partition('id="model"')[0]
    before = page.stat().st_mtime_ns
    shell("run", "letters")
    assert page.stat().st_mtime_ns == before  # nothing new to say
    assert shell("report", "letters.refdgs", "--out", "other.html").stdout == "other.html\n"
    assert (shell.root / "other.html").read_text() == text


def test_a_failed_run_leaves_a_report_that_says_so(shell: Shell) -> None:
    result = shell("run", "letters", "--set", "shout.mood=mute", code=68)
    assert "error: no voice" in result.stderr
    text = (shell.work / "report.html").read_text()
    assert 'class="verdict failed"' in text and "no voice. Set shout.mood" in text
    shell("run", "letters", "--set", "shout.mood=calm")
    assert 'class="verdict unjudged"' in (shell.work / "report.html").read_text()


def test_a_report_that_cannot_be_written_is_only_a_warning(shell: Shell) -> None:
    (shell.work / "report.html").mkdir(parents=True)
    result = shell("run", "letters")
    assert result.stdout == f"{shell.work / 'asset'}\n"
    assert "report: warning: not written" in result.stderr
    assert json.loads(shell("run", "letters", "--json").stdout)["report"] is None


def test_the_exported_files_get_the_name_of_the_recipe(tmp_path: Path) -> None:
    own = tmp_path / "mine.toml"
    own.write_text("# For a test.\nextends = 'preview'\n")

    def named(recipe: str, *assignments: str) -> str:
        memory = Memory((tmp_path,), recipe, assignments)
        export: Any = open_workspace(tmp_path / "work", memory).settings["export"]
        return str(export.recipe)

    assert named("glossy") == "glossy" and named(str(own)) == "mine"
    assert named("glossy", "export.recipe='other'") == "other"


def test_a_workspace_with_settings_under_their_old_names_opens_and_is_renamed(
    tmp_path: Path,
) -> None:
    old = ["train.look_steps=5", "train.seed=2", "train.renew_surfels=1.5", "train.iterations=9"]
    record = {"photos": [["photos", str(tmp_path)]], "recipe": "preview", "set": old}
    (tmp_path / "workspace.json").write_text(json.dumps(record))
    said: list[str] = []
    space = open_workspace(tmp_path, tell=said.append)
    settings: Any = space.settings
    assert (settings["start"].look_steps, settings["start"].seed) == (5, 2)
    assert settings["refine"].surfels == 1.5 and settings["train"].iterations == 9
    assert said[0] == "--set train.look_steps=5: train.look_steps is now start.look_steps"
    assert len(said) == 3
    assert space.memory.assignments == (
        "start.look_steps=5",
        "start.seed=2",
        "refine.surfels=1.5",
        "train.iterations=9",
    )
    again: list[str] = []
    open_workspace(tmp_path, space.memory, tell=again.append)
    assert again == []
