"""Laws of what a run says while it works."""

import json
from pathlib import Path

import pytest

from refdgs_pipe.cli import console
from refdgs_pipe.cli.console import Console, Estimate
from refdgs_pipe.cli.forecast import PRIOR_S, Forecast
from refdgs_pipe.cli.logs import RunLog
from refdgs_pipe.formatting import counted, duration, figure, roughly, size
from refdgs_pipe.pipeline.catalog import STAGES
from refdgs_pipe.pipeline.events import (
    Damaged,
    Finished,
    Measured,
    Progress,
    Sampled,
    Started,
    Warned,
)
from refdgs_pipe.stage_words import DOING


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


def test_plain_lines_come_now_and_then_with_the_time_left_of_the_whole_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock()
    monkeypatch.setattr(console, "time", clock)
    speak = Console()
    speak.forecast = Forecast({"train": 900.0, "extract": 60.0})
    speak(Started("train", "never run"))
    for second in range(100):
        clock.now = float(second)
        speak(Progress("train", "training", second, 1000, "loss 0.1", second / 1000))
    speak(Finished("train", 99.0))
    assert capsys.readouterr().err.splitlines() == [
        "train: learning shape and reflections",
        "train: training 10/1000, loss 0.1, about 18 min left in all",
        "train: training 40/1000, loss 0.1, about 17 min left in all",
        "train: training 70/1000, loss 0.1, about 16 min left in all",
        "train: done in 1 min 39 s",
    ]


def test_the_time_left_is_never_none_and_never_a_tenth_of_a_second(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = Clock()
    monkeypatch.setattr(console, "time", clock)
    speak = Console()
    speak(Started("bake", "never run"))
    for second in range(0, 60, 5):
        clock.now = float(second)
        speak(Progress("bake", "gathering texels", min(second, 40), 40))
    said = capsys.readouterr().err
    assert " 0.0 s" not in said and "some seconds left in this part" not in said.splitlines()[-1]


def test_a_part_of_a_stage_does_not_hide_the_parts_after_it() -> None:
    whole = Forecast({"sfm": 100.0, "train": 300.0})
    assert whole.left_s("sfm", 10.0, 2.0, sure=False) == pytest.approx(390.0)
    assert whole.left_s("sfm", 10.0, 2.0, sure=True) == pytest.approx(302.0)


def test_a_slow_machine_makes_the_rest_of_the_forecast_longer() -> None:
    whole = Forecast({"masks": 100.0, "train": 300.0})
    whole.finished("masks", 300.0)
    assert whole.expect("train") == pytest.approx(300.0 * 3 ** (100 / (100 + PRIOR_S)))


def test_photos_that_are_hard_to_place_do_not_make_the_machine_slow() -> None:
    whole = Forecast({"sfm": 50.0, "train": 300.0})
    whole.finished("sfm", 600.0)
    assert 300.0 < whole.expect("train") < 400.0


def test_a_busy_machine_is_said_and_counted() -> None:
    whole = Forecast({"train": 300.0}, busy=4.0)
    assert whole.expect("train") == pytest.approx(1200.0)
    assert "about 4 times as slow" in whole.lines()[0]


def test_the_plan_says_the_whole_run_and_each_stage_in_columns() -> None:
    lines = Forecast({"sfm": 40.0, "train": 540.0, "report": 12.0}, 190_000_000).lines()
    assert lines == [
        "the rest of the run takes about 10 min and fills about 190 MB of the disk:",
        "  sfm     about 40 s   finding the cameras",
        "  train   about 9 min  learning shape and reflections",
        "  report  about 10 s   drawing the report",
    ]


def test_a_training_that_goes_on_says_from_which_step(capsys: pytest.CaptureFixture[str]) -> None:
    speak = Console()
    speak(Started("train", "never run"))
    speak(Progress("train", "training", 3010, 5000))
    assert "train: training from step 3010" in capsys.readouterr().err.splitlines()


def test_a_stage_that_is_made_again_says_what_it_does_and_why(
    capsys: pytest.CaptureFixture[str],
) -> None:
    Console()(Started("extract", "voxel 0.004 -> 0.002"))
    assert capsys.readouterr().err == "extract: making a mesh (voxel 0.004 -> 0.002)\n"


def test_every_stage_of_the_product_has_words() -> None:
    assert [name for name in (*STAGES, "start", "shape", "refine") if name not in DOING] == []


def test_twenty_equal_warnings_are_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    speak = Console()
    for number in range(20):
        speak(Warned("ingest", f"IMG_{number}.jpg: the clock is wrong"))
    speak(Warned("ingest", "no masks: edges are guessed"))
    speak(Finished("ingest", 1.0))
    assert capsys.readouterr().err.splitlines()[:2] == [
        "ingest: warning: IMG_0.jpg and 19 more: the clock is wrong",
        "ingest: warning: no masks: edges are guessed",
    ]


def test_a_warning_before_an_error_is_not_lost(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError), Console() as speak:
        speak(Warned("train", "no memory"))
        raise RuntimeError
    assert capsys.readouterr().err == "warning: no memory\n"


def test_estimates_are_said_coarsely() -> None:
    values = (0.0, 7.0, 12.0, 44.0, 58.0, 200.0, 1500.0, 7200.0, 80_000.0)
    assert [roughly(value) for value in values] == [
        "some seconds",
        "some seconds",
        "about 10 s",
        "about 40 s",
        "about 1 min",
        "about 3 min",
        "about 25 min",
        "about 2.0 h",
        "about 22 h",
    ]


def test_quiet_says_only_what_is_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    speak = Console(verbosity=0)
    speak(Started("sfm", "never run"))
    speak(Measured("sfm", "points", 3))
    speak(Warned("sfm", "2 photos lost"))
    speak(Damaged("sfm", "cameras.txt: missing", ".damaged-1"))
    assert capsys.readouterr().err.splitlines() == [
        "sfm: warning: 2 photos lost",
        "sfm: warning: cameras.txt: missing. Set aside as .damaged-1, made again",
    ]


def test_verbose_says_every_figure(capsys: pytest.CaptureFixture[str]) -> None:
    Console(verbosity=2)(Measured("train", "PSNR", 27.123456, "dB"))
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
