"""Many captures: the table, the three jobs of each, what is recorded and what is tried again."""

import json
import signal
import time
from pathlib import Path

import pytest
from batches import BatchShell, needs_snakemake

PARTS = ("prepare", "train", "finish")


@pytest.fixture
def shell(tmp_path: Path) -> BatchShell:
    return BatchShell(tmp_path, forks=True)


def wait_for(shell: BatchShell, pattern: str) -> None:
    """Wait until a file of the batch is there."""
    deadline = time.monotonic() + 30
    while not list(shell.batch.glob(pattern)):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_init_writes_a_table_a_snakefile_and_three_profiles(shell: BatchShell) -> None:
    shell.init("--set", "shout.marks=3", ball="hello", cup="world")
    lines = (shell.batch / "captures.tsv").read_text().splitlines()
    assert lines[0].split("\t") == ["capture", "photos", "recipe", "set"]
    assert lines[1].split("\t") == ["ball", str(shell.root / "ball"), "glossy", "shout.marks=3"]
    assert (shell.batch / "Snakefile").is_file()
    profiles = {path.parent.name for path in shell.batch.glob("profiles/*/config.yaml")}
    assert profiles == {"local", "slurm", "kubernetes"}


def test_init_adds_captures_and_keeps_what_a_person_edited(shell: BatchShell) -> None:
    shell.init(ball="hello")
    (shell.batch / "profiles" / "slurm" / "config.yaml").write_text("executor: slurm # mine\n")
    before = (shell.batch / "Snakefile").read_text()
    shell("batch", "init", "ball", *shell.captures(cup="world"), "--out", "B")
    assert list(shell.states()) == ["ball", "cup"]
    assert (shell.batch / "Snakefile").read_text() == before
    assert "mine" in (shell.batch / "profiles" / "slurm" / "config.yaml").read_text()


def test_folders_of_one_name_and_odd_names_become_different_captures(shell: BatchShell) -> None:
    shell.captures(ball="one")
    for name in ("other/ball", "a (1)", "ä"):
        (shell.root / name).mkdir(parents=True)
        (shell.root / name / "a.txt").write_text("hello")
    shell("batch", "init", "ball", "other/ball", "a (1)", "ä", "--out", "B")
    assert list(shell.states()) == ["ball", "ball-2", "a-1", "capture"]


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["nowhere"], 65, "nowhere: no such file or folder"),
        (["ball", "--recipe", "glosy"], 64, "Did you mean glossy?"),
        (["ball", "--set", "shout.speed=1"], 64, "no setting 'speed'"),
        ([".", "--recipe", "glossy"], 64, "inside the capture"),
    ],
)
def test_mistakes_are_said_before_a_batch_is_made(
    shell: BatchShell, arguments: list[str], code: int, words: str
) -> None:
    shell.captures(ball="hello")
    assert words in shell("batch", "init", *arguments, "--out", "B", code=code).stderr
    assert not shell.batch.exists()


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("../up\tball\tglossy\t", "line 3: a capture called '../up'"),
        ("ball\tball\tglossy\t", "line 3: a second capture called ball"),
        ("cup\t\tglossy\t", "line 3: no photos"),
        ("cup\tball\tglossy\t'", "line 3: set is not readable"),
    ],
)
def test_a_wrong_row_of_the_table_is_named(shell: BatchShell, row: str, words: str) -> None:
    shell.init(ball="hello")
    with (shell.batch / "captures.tsv").open("a") as table:
        table.write(row + "\n")
    assert words in shell("batch", "status", "B", code=64).stderr


def test_three_jobs_make_the_asset_and_each_makes_its_own_stages(shell: BatchShell) -> None:
    shell.init(ball="hello")
    for part in PARTS:
        shell.step("ball", part)
    made = {part: list(shell.result("ball", part)["made"]) for part in PARTS}
    assert made == {"prepare": ["read"], "train": ["shout"], "finish": ["export"]}
    finish = shell.result("ball")
    assert (shell.batch / finish["asset"] / "text").read_text() == "HELLO! (hello) 20.0"
    assert (shell.batch / finish["report"]).is_file()
    assert shell.states() == {"ball": "done"}


def test_what_another_attempt_cannot_mend_is_recorded_and_its_other_jobs_are_skipped(
    shell: BatchShell,
) -> None:
    shell.init(bad="unusable")
    assert "letter 1 is unusable" in shell.step("bad", "prepare")
    shell.step("bad", "train")
    shell.step("bad", "finish")
    first = shell.result("bad", "prepare")
    assert (first["status"], first["exit_code"]) == ("failed", 65)
    assert shell.result("bad")["status"] == "skipped"
    assert shell.states() == {"bad": "failed"}


def test_a_mistake_of_ours_is_recorded_with_its_traceback(shell: BatchShell) -> None:
    shell.init(odd="bug")
    process = shell.start("batch", "step", "B", "odd", "prepare")
    _, said = process.communicate(timeout=60)
    assert process.returncode == 0 and "KeyError: 'a mistake of ours'" in said
    assert shell.result("odd", "prepare")["exit_code"] == 70


@pytest.mark.parametrize(
    ("number", "code", "memory"), [(0, 76, 1), (28, 73, 0), (5, 77, 0), (24, 78, 0)]
)
def test_what_may_pass_leaves_no_result_and_asks_for_memory_only_where_that_was_short(
    shell: BatchShell, number: int, code: int, memory: int
) -> None:
    shell.init(ball=f"fail {number}")
    shell.step("ball", "prepare", code=code)
    assert not (shell.batch / "steps" / "ball" / "prepare.json").exists()
    note = json.loads((shell.batch / "steps" / "ball" / "prepare.attempts.json").read_text())
    assert (note["count"], note["memory"], note["exit_code"]) == (1, memory, code)
    assert shell.states() == {"ball": "to retry"}


def test_a_killed_job_counts_as_one_that_may_lack_memory(shell: BatchShell) -> None:
    shell.init(ball="hello")
    process = shell.start("batch", "step", "B", "ball", "train", FAKE_STEP_S="0.3")
    wait_for(shell, "workspaces/ball.refdgs/shout/.scratch-*/done")
    assert shell.states() == {"ball": "running"}
    process.kill()
    process.communicate(timeout=20)
    assert shell.states() == {"ball": "waiting"}  # of prepare, which never ran
    note = json.loads((shell.batch / "steps" / "ball" / "train.attempts.json").read_text())
    assert note["running"]
    shell.step("ball", "train")
    shell.step("ball", "prepare")
    shell.step("ball", "finish")
    resumed = next(shell.workspace("ball").glob("shout/*/manifest.json")).read_text()
    assert ["resumed at", 0, ""] not in json.loads(resumed)["measures"]


def test_a_job_that_is_told_to_stop_ends_with_75_and_goes_on_from_its_checkpoint(
    shell: BatchShell,
) -> None:
    shell.init(ball="hello")
    process = shell.start("batch", "step", "B", "ball", "train", FAKE_STEP_S="0.2")
    wait_for(shell, "workspaces/ball.refdgs/shout/.scratch-*/done")
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=20)
    assert process.returncode == 75
    shell.step("ball", "train")
    resumed = next(shell.workspace("ball").glob("shout/*/manifest.json")).read_text()
    assert ["resumed at", 0, ""] not in json.loads(resumed)["measures"]


def test_a_capture_that_is_running_is_not_started_twice(shell: BatchShell) -> None:
    shell.init(ball="hello")
    first = shell.start("batch", "step", "B", "ball", "train", FAKE_STEP_S="0.6")
    wait_for(shell, "workspaces/ball.refdgs/shout/.scratch-*/done")
    said = shell("batch", "step", "B", "ball", "train", "--wait", "0", code=72).stderr
    assert "is working here" in said
    second = shell.step("ball", "train")  # waits, and finds the work done
    first.communicate(timeout=20)
    assert first.returncode == 0
    assert "shout: up to date" in second and "shout: done" not in second


def test_status_names_the_worst_first_words_and_counts(shell: BatchShell) -> None:
    shell.init(ball="hello", bad="unusable")
    shell.step("bad", "prepare")
    said = shell("batch", "status", "B").stdout
    assert "2 captures: 1 waiting, 1 failed" in said
    assert "bad  failed  prepare (65)" in said and "letter 1 is unusable" in said
    assert "ball" not in said and "ball" in shell("batch", "status", "B", "--all").stdout


def test_a_result_of_another_capture_or_a_damaged_one_counts_for_nothing(
    shell: BatchShell,
) -> None:
    shell.init(ball="hello", cup="world")
    for part in PARTS:
        shell.step("ball", part)
    steps = shell.batch / "steps"
    (steps / "cup").mkdir()
    (steps / "cup" / "finish.json").write_text((steps / "ball" / "finish.json").read_text())
    whole = json.loads((steps / "ball" / "finish.json").read_text())
    damages = [{"verdict": "good"}, {"verdict": {"word": "good"}}, {"asset": 1}, {"seconds": ""}]
    for text in ['{"capture": "ball"', *(json.dumps(whole | damage) for damage in damages)]:
        (steps / "ball" / "finish.json").write_text(text)
        assert shell.states() == {"ball": "waiting", "cup": "waiting"}


def test_the_page_links_every_report_and_names_cannot_become_markup(shell: BatchShell) -> None:
    shell.init(ball="hello")
    with (shell.batch / "captures.tsv").open("a") as table:
        table.write("bad\t<script>alert(1)</script>\tglossy\t\n")
    shell.step("bad", "prepare")
    for part in PARTS:
        shell.step("ball", part)
    (shell.batch / "workspaces" / "ball.refdgs" / "asset" / "preview.png").write_bytes(b"png")
    shell("batch", "report", "B")
    page = (shell.batch / "report.html").read_text()
    assert '<a href="workspaces/ball.refdgs/report.html">ball</a>' in page
    assert '<img src="workspaces/ball.refdgs/asset/preview.png"' in page
    assert "img-src 'self' file:" in page
    assert "<script>alert" not in page and "&lt;script&gt;alert" in page


@needs_snakemake
def test_a_batch_brings_every_capture_to_its_end_and_a_second_run_does_nothing(
    shell: BatchShell,
) -> None:
    shell.init(ball="hello", bad="unusable", cup="world")
    said = shell("batch", "run", "B", "--cores", "2", code=65).stderr
    assert "3 captures: 2 done, 1 failed" in said
    assert shell.states() == {"ball": "done", "bad": "failed", "cup": "done"}
    made = shell.made()
    again = shell("batch", "run", "B", "--cores", "2", code=65).stderr
    assert "3 of 3 captures are up to date" in again and "Building DAG" not in again
    assert shell.made() == made


@needs_snakemake
def test_changed_photos_are_run_again_and_the_others_are_not(shell: BatchShell) -> None:
    shell.init(bad="unusable", cup="world")
    shell("batch", "run", "B", "--cores", "2", code=65)
    cup = {path: t for path, t in shell.made().items() if "cup" in str(path)}
    shell.captures(bad="mended")
    said = shell("batch", "run", "B", "--cores", "2").stderr
    assert "1 of 2 captures are up to date" in said
    assert shell.states() == {"bad": "done", "cup": "done"}
    assert cup.items() <= shell.made().items()


@needs_snakemake
def test_a_changed_setting_runs_only_the_jobs_that_it_concerns(shell: BatchShell) -> None:
    shell.init(ball="hello")
    shell("batch", "run", "B", "--cores", "1")
    table = shell.batch / "captures.tsv"
    table.write_text(table.read_text().replace("glossy\t", "glossy\texport.width=30"))
    said = shell("batch", "run", "B", "--cores", "1").stderr
    assert "1 of 1 steps" in said and "Rule: finish" in said
    text = (shell.workspace("ball") / "asset" / "text").read_text()
    assert text == "HELLO! (hello) 30.0"


@needs_snakemake
def test_results_that_were_deleted_are_made_again_though_the_notes_say_done(
    shell: BatchShell,
) -> None:
    shell.init(ball="hello")
    shell("batch", "run", "B", "--cores", "1")
    for path in shell.workspace("ball").glob("shout/*/text"):
        path.unlink()
    said = shell("batch", "run", "B", "--cores", "1").stderr
    assert "0 of 1 captures are up to date" in said
    assert (shell.workspace("ball") / "asset" / "text").read_text() == "HELLO! (hello) 20.0"


@needs_snakemake
def test_attempts_are_limited_and_the_batch_says_how_to_go_on(shell: BatchShell) -> None:
    shell.init(ball="fail 28", cup="world")
    path = shell.batch / "Snakefile"
    path.write_text(path.read_text().replace("RETRIES = 3", "RETRIES = 1"))
    said = shell("batch", "run", "B", "--cores", "2", code=73).stderr
    assert "try again: refdgs-pipe batch run" in said
    found = {one["capture"]: one for one in shell.json("batch", "status", "B")["captures"]}
    assert found["ball"]["state"] == "to retry" and found["ball"]["attempts"] == 2
    assert found["cup"]["state"] == "done"


@needs_snakemake
def test_shards_finish_every_capture(shell: BatchShell) -> None:
    shell.init(a="one", b="two", c="three")
    said = shell("batch", "run", "B", "--cores", "2", "--shard", "2").stderr
    assert "captures 1 to 2" in said and "captures 3 to 3" in said
    assert set(shell.states().values()) == {"done"}


@needs_snakemake
def test_a_second_run_of_a_batch_is_refused_and_a_stopped_one_goes_on(shell: BatchShell) -> None:
    shell.init(ball="hello")
    process = shell.start("batch", "run", "B", "--cores", "1", FAKE_STEP_S="0.3")
    wait_for(shell, "workspaces/ball.refdgs/shout/.scratch-*/done")
    assert "this batch is running" in shell("batch", "run", "B", code=72).stderr
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 75 and "run again to go on" in said
    assert shell.states() == {"ball": "to retry"}
    shell("batch", "run", "B", "--cores", "1")
    assert shell.states() == {"ball": "done"}


@needs_snakemake
def test_a_batch_may_be_in_a_folder_with_an_odd_name(tmp_path: Path) -> None:
    root = tmp_path / "a b's: {x} [1]"
    root.mkdir()
    shell = BatchShell(root, forks=True)
    shell.init(ball="hello")
    shell("batch", "run", "B", "--cores", "1")
    assert shell.states() == {"ball": "done"}


@needs_snakemake
def test_an_unknown_profile_is_named(shell: BatchShell) -> None:
    shell.init(ball="hello")
    said = shell("batch", "run", "B", "--profile", "moon", code=64).stderr
    assert "there are kubernetes, local, slurm" in said


def test_a_folder_that_is_no_batch_is_named(shell: BatchShell) -> None:
    assert "batch init" in shell("batch", "run", "letters", code=64).stderr
