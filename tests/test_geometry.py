"""The one function that turns the world to +Y up."""

import numpy as np
import pytest

from refdgs_pipe.geometry import y_up_from_z_up


def test_z_up_becomes_y_up_by_the_quarter_turn_of_every_tool() -> None:
    turn = y_up_from_z_up(np.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(turn @ [1, 2, 3], [1, 3, -2], atol=1e-12)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (0, 1, 0), (0.3, -0.5, 0.2), (1, 0, 0)])
def test_any_up_becomes_plus_y_without_mirroring(up: tuple[float, float, float]) -> None:
    turn = y_up_from_z_up(np.array(up, float))
    np.testing.assert_allclose(turn @ up / np.linalg.norm(up), [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) > 0
