"""How much a view may work while a run goes on."""

from dataclasses import dataclass

import pytest

from refdgs_pipe.viewing.effort import SHARE, Effort


@dataclass
class Machine:
    """Clocks that stand still until they are moved."""

    now: float = 0.0
    spent: float = 0.0
    run: float | None = 100.0

    def effort(self, cores: int = 2) -> Effort:
        return Effort(cores, now=lambda: self.now, spent=lambda: self.spent)

    def passes(self, seconds: float, rate: float) -> None:
        """Time in which the run uses so many cores."""
        self.now += seconds
        if self.run is not None:
            self.run += rate * seconds


@pytest.mark.parametrize("rate", [2.0, 0.3], ids=["alone", "on a crowded machine"])
def test_no_more_is_spent_than_a_share_of_what_the_run_spends(rate: float) -> None:
    machine = Machine()
    effort = machine.effort()
    machine.spent = 0.5  # the start
    assert machine.run is not None
    before = machine.run
    for _ in range(100_000):
        machine.passes(0.01, rate)
        if effort.allows(is_running=True, run_s=machine.run):
            machine.spent += 0.2  # a picture
    allowed = SHARE * (machine.run - before)
    assert machine.spent <= allowed + 0.2
    assert machine.spent >= allowed - 0.4  # what it may have is used


def test_a_run_whose_work_is_not_known_is_taken_to_use_some_of_its_cores() -> None:
    machine = Machine(run=None)
    effort = machine.effort()
    for _ in range(10_000):
        machine.passes(0.1, 0.0)
        if effort.allows(is_running=True, run_s=None):
            machine.spent += 0.2
    assert 0.5 * SHARE * 2 * machine.now < machine.spent < SHARE * 2 * machine.now


def test_a_long_rest_does_not_allow_a_long_effort() -> None:
    machine = Machine()
    effort = machine.effort()
    effort.allows(is_running=True, run_s=machine.run)
    machine.passes(100_000.0, 2.0)
    done = 0
    while effort.allows(is_running=True, run_s=machine.run):
        machine.spent += 1.0
        done += 1
    assert done <= 7


def test_without_a_run_there_is_no_limit() -> None:
    machine = Machine()
    effort = machine.effort()
    for _ in range(1000):
        machine.spent += 1.0
        assert effort.allows(is_running=False, run_s=None)


def test_what_was_spent_before_a_run_is_not_held_against_it() -> None:
    machine = Machine()
    effort = machine.effort()
    machine.spent = 100.0
    effort.allows(is_running=False, run_s=None)
    assert effort.allows(is_running=True, run_s=machine.run)


def test_a_run_that_follows_another_one_is_counted_anew() -> None:
    machine = Machine()
    effort = machine.effort()
    effort.allows(is_running=True, run_s=1000.0)
    machine.spent += 1.0
    assert not effort.allows(is_running=True, run_s=3.0)
    assert effort.allows(is_running=True, run_s=3.0 + 1.01 / SHARE)
