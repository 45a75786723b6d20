"""The emulated grid itself: it notices what a GPU would not forgive."""

import pytest
from emulation import ORDERS

grid = pytest.importorskip("_refdgs_emulated")


def test_lanes_add_any_number_of_values() -> None:
    assert grid.lane_errors() == [0.0] * 32


@pytest.mark.parametrize("order", ORDERS)
def test_a_missing_barrier_shows(order: int) -> None:
    assert grid.wrong_neighbours(order, True) == 0
    assert grid.wrong_neighbours(order, False) > 0


def test_a_barrier_that_not_all_threads_reach_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="not every thread reaches"):
        grid.leave_early()
