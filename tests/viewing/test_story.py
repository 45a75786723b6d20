"""What a view reads in the logs of runs."""

import json
from pathlib import Path
from typing import Any

from refdgs_pipe.viewing.story import Logs, told


def run(*events: dict[str, Any]) -> list[dict[str, Any]]:
    """Events with a time."""
    return [{"time": 100.0 + i, **event} for i, event in enumerate(events)]


def sampled(step: int, stage: str = "train", loss: float = 0.5) -> dict[str, Any]:
    figures = {"loss": loss, "psnr": 20.0, "surfels": 9}
    return {"event": "sampled", "stage": stage, "step": step, "steps": 1000, "figures": figures}


START = {"event": "run"}
TRAIN = {"event": "started", "stage": "train"}


def write(path: Path, events: list[dict[str, Any]], mode: str = "w") -> None:
    path.parent.mkdir(exist_ok=True)
    with path.open(mode) as file:
        file.writelines(json.dumps(event) + "\n" for event in events)


def test_the_stage_that_began_last_and_has_not_finished_is_the_running_one() -> None:
    progress = {"event": "progress", "stage": "train", "label": "training", "done": 3, "total": 9}
    story = told([run(START, TRAIN, progress)])
    assert (story.stage, story.label, story.done, story.total) == ("train", "training", 3, 9)
    assert (story.begun, story.told, story.stage_begun) == (100.0, 102.0, 101.0)
    over = told([run(START, TRAIN, progress, {"event": "finished", "stage": "train"})])
    assert over.stage is None


def test_a_resumed_training_has_the_curve_of_the_run_before_too() -> None:
    story = told([run(START, TRAIN, sampled(10), sampled(600)), run(START, TRAIN, sampled(500))])
    assert [point[0] for point in story.curve] == [10, 500]
    assert story.steps == 1000


def test_a_training_that_began_anew_has_no_curve_of_an_older_one() -> None:
    old = run(START, TRAIN, sampled(10), sampled(900))
    assert told([old, run(START, TRAIN)]).curve == ()
    assert [p[0] for p in told([old, run(START, TRAIN, sampled(10))]).curve] == [10]


def test_a_run_without_training_keeps_the_curve() -> None:
    old = run(START, TRAIN, sampled(10), sampled(900, "refine"))
    story = told([old, run(START, {"event": "started", "stage": "export"})])
    assert [point[0] for point in story.curve] == [10, 900]


def test_a_failure_is_told() -> None:
    assert told([run(START, {"event": "failed", "message": "no room"})]).failure == "no room"


def test_a_log_is_read_on_from_where_it_was_left(tmp_path: Path) -> None:
    logs, path = Logs(tmp_path / "logs"), tmp_path / "logs" / "20260101-000000-1.jsonl"
    assert logs.read().stage is None  # there is none
    write(path, run(START, TRAIN))
    assert logs.read().stage == "train"
    line = json.dumps(sampled(10))
    with path.open("a") as file:
        file.write(line[:20])  # the rest of the line is not written yet
    assert logs.read().curve == ()
    with path.open("a") as file:
        file.write(line[20:] + "\n")
    assert [point[0] for point in logs.read().curve] == [10]


def test_the_newest_log_counts(tmp_path: Path) -> None:
    logs = Logs(tmp_path / "logs")
    write(tmp_path / "logs" / "20260101-000000-1.jsonl", run(START, TRAIN))
    logs.read()
    write(tmp_path / "logs" / "20260102-000000-1.jsonl", run(START))
    assert logs.read().stage is None


def test_damaged_lines_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "logs" / "20260101-000000-1.jsonl"
    bad = [{"event": "sampled", "stage": "train", "step": "x"}, {"event": ["run"]}, {"no": 1}]
    write(path, [*run(START, TRAIN), *bad])
    with path.open("ab") as file:
        file.write(b"\xff{\n[1]\n")
    story = Logs(tmp_path / "logs").read()
    assert story.stage == "train"
    assert story.curve == ()
