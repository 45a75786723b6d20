"""How much a view may work while a run goes on."""

from dataclasses import dataclass

from refdgs_pipe.viewing.effort import SHARE, Effort


@dataclass
class Machine:
    """Clocks that stand still until they are moved."""

    now: float = 0.0
    spent: float = 0.0

    def effort(self, cores: int = 2) -> Effort:
        return Effort(cores, now=lambda: self.now, spent=lambda: self.spent)


def test_over_a_run_no_more_than_the_share_is_spent() -> None:
    machine = Machine()
    effort = machine.effort()
    machine.spent = 1.0  # the start
    for _ in range(100_000):
        machine.now += 0.01
        if effort.allows(is_running=True):
            machine.spent += 0.2  # a picture
    assert machine.spent <= SHARE * 2 * machine.now + 0.2
    assert machine.spent >= SHARE * 2 * machine.now - 0.4  # and what it may have is used


def test_a_long_rest_does_not_allow_a_long_effort() -> None:
    machine = Machine()
    effort = machine.effort()
    effort.allows(is_running=True)
    machine.now = 100_000.0
    done = 0
    while effort.allows(is_running=True):
        machine.spent += 1.0
        done += 1
    assert done <= 7


def test_without_a_run_there_is_no_limit() -> None:
    machine = Machine()
    effort = machine.effort()
    for _ in range(1000):
        machine.spent += 1.0
        assert effort.allows(is_running=False)


def test_what_was_spent_before_a_run_is_not_held_against_it() -> None:
    machine = Machine()
    effort = machine.effort()
    machine.spent = 100.0
    effort.allows(is_running=False)
    machine.now += 1.0
    assert effort.allows(is_running=True)
