"""Laws of what a run says while it works."""

import json
from pathlib import Path

import pytest

from refdgs_pipe.cli import console
from refdgs_pipe.cli.console import Console, Estimate
from refdgs_pipe.cli.logs import RunLog
from refdgs_pipe.formatting import counted, duration, figure, size
from refdgs_pipe.pipeline.events import (
    Damaged,
    Finished,
    Measured,
    Progress,
    Sampled,
    Started,
    Warned,
)


def test_durations_and_sizes_are_said_with_the_digits_that_matter() -> None:
    values = (0.04, 9.94, 12.3, 60, 200, 3600, 7500)
    words = ["0.0 s", "9.9 s", "12 s", "1 min", "3 min 20 s", "1 h 0 min", "2 h 5 min"]
    assert [duration(value) for value in values] == words
    assert [size(count) for count in (999, 1500, 2_500_000)] == ["999 B", "1.5 kB", "2.5 MB"]
    assert [figure(value) for value in (3, 0.123456, "x")] == ["3", "0.1235", "x"]


def test_the_estimate_follows_the_speed_of_the_last_half_minute() -> None:
    estimate = Estimate()
    assert estimate.remaining_s(Progress("train", "training", 0, 1000), 0.0) is None
    for second in range(1, 101):  # one step a second
        left = estimate.remaining_s(Progress("train", "training", second, 1000), float(second))
    assert left == pytest.approx(900)
    for second in range(101, 141):  # then two
        done = 100 + 2 * (second - 100)
        left = estimate.remaining_s(Progress("train", "training", done, 1000), float(second))
    assert left == pytest.approx((1000 - 180) / 2)


def test_the_estimate_follows_the_work_where_steps_differ_in_cost() -> None:
    estimate = Estimate()
    estimate.remaining_s(Progress("train", "training", 0, 100, "", 0.0), 0.0)
    left = estimate.remaining_s(Progress("train", "training", 50, 100, "", 0.25), 10.0)
    assert left == pytest.approx(30)


def test_a_new_phase_starts_a_new_estimate_and_no_total_gives_none() -> None:
    estimate = Estimate()
    estimate.remaining_s(Progress("sfm", "features", 0, 10), 0.0)
    assert estimate.remaining_s(Progress("sfm", "matching", 5, 10), 5.0) is None
    assert estimate.remaining_s(Progress("sfm", "mapping", 5, None), 9.0) is None


class Clock:
    """Stands in for the time module."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now


def test_plain_lines_come_now_and_then_with_the_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock()
    monkeypatch.setattr(console, "time", clock)
    speak = Console({"train": None, "extract": 60.0})
    speak(Started("train", "never run"))
    for second in range(100):
        clock.now = float(second)
        speak(Progress("train", "training", second, 1000, "loss 0.1"))
    speak(Finished("train", 99.0))
    assert capsys.readouterr().err.splitlines() == [
        "train: never run",
        "train: training 10/1000, loss 0.1, about 16 min 30 s left, 17 min 30 s in all",
        "train: training 40/1000, loss 0.1, about 16 min left, 17 min in all",
        "train: training 70/1000, loss 0.1, about 15 min 30 s left, 16 min 30 s in all",
        "train: done in 1 min 39 s",
    ]


def test_a_stage_that_never_ran_leaves_the_whole_run_unestimated() -> None:
    speak = Console({"extract": 60.0, "clean": None})
    assert speak._left(30.0) == "about 30 s left"
    assert speak._left(None) == ""


def test_quiet_says_only_what_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    speak = Console({}, verbosity=0)
    speak(Started("sfm", "never run"))
    speak(Measured("sfm", "points", 3))
    speak(Warned("sfm", "2 photos lost"))
    speak(Damaged("sfm", "cameras.txt: missing", ".damaged-1"))
    assert capsys.readouterr().err.splitlines() == [
        "sfm: warning: 2 photos lost",
        "sfm: warning: cameras.txt: missing. Set aside as .damaged-1, made again",
    ]


def test_verbose_says_every_figure(capsys: pytest.CaptureFixture[str]) -> None:
    Console({}, verbosity=2)(Measured("train", "PSNR", 27.123456, "dB"))
    assert capsys.readouterr().err == "train: PSNR 27.12 dB\n"


def test_numbers_of_things_agree_with_their_nouns() -> None:
    assert [counted(n, "photo") for n in (0, 1, 2)] == ["no photos", "1 photo", "2 photos"]


def test_the_log_keeps_some_figures_and_the_last_as_numbers(tmp_path: Path) -> None:
    log = RunLog(tmp_path)
    for step in (1, 2, 3):
        log(Sampled("train", step, 3, {"loss": 1 / step}))
        log(Progress("train", "training", step, 3))
    log.close()
    lines = [json.loads(line) for line in log.path.read_text().splitlines()]
    assert [line["step"] for line in lines if line["event"] == "sampled"] == [1, 3]
    assert [line["figures"] for line in lines if line["event"] == "sampled"][1] == {"loss": 1 / 3}
    assert [line["done"] for line in lines if line["event"] == "progress"] == [1, 3]
