"""The ball and the up direction chosen by hand: as settings that give just that."""

from dataclasses import replace

import finished
import numpy as np
import pytest

from refdgs_pipe import recipe
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.sfm.report import overridden
from refdgs_pipe.sfm.settings import GateParams
from refdgs_pipe.viewing.adjusting import Choice, assignments, tilted
from refdgs_pipe.viewing.contents import Scene

PHOTOS = replace(finished.model(), sfm_from_world=np.diag([2.0, 2.0, 2.0, 1.0]))
KNOWN = finished.model()


def applied(model: SparseModel, texts: list[str]) -> SparseModel:
    """What the stage `gate` makes of a model with these settings."""
    settings = recipe.resolve(recipe.load("glossy"), texts, {"gate": GateParams})["gate"]
    assert isinstance(settings, GateParams)
    return overridden(model, settings.up, settings.ball_center, settings.ball_radius)


def test_what_was_not_changed_is_not_set() -> None:
    assert assignments(Scene(KNOWN, None, None), Choice.of(KNOWN)) == []


def test_only_what_differs_is_set() -> None:
    choice = replace(Choice.of(KNOWN), radius=0.75)
    assert assignments(Scene(KNOWN, None, None), choice) == ["gate.ball_radius=0.75"]


@pytest.mark.parametrize("model", [PHOTOS, KNOWN], ids=["photos", "known poses"])
@pytest.mark.parametrize("before", [None, (0.3, -0.2, 0.9)], ids=["found", "set before"])
def test_the_settings_give_what_was_chosen(
    model: SparseModel, before: tuple[float, float, float] | None
) -> None:
    shown = overridden(model, before, None, None)
    up = tilted(shown.up, 20.0, -10.0)
    choice = Choice(np.array([0.2, -0.1, 0.7]), 0.9, up)
    result = applied(model, assignments(Scene(shown, None, before), choice))

    def seen(found: SparseModel, center: np.ndarray, up: np.ndarray) -> np.ndarray:
        """Centre and up direction as the first camera sees them: the same in every frame."""
        turn, move = found.cameras[0].cam_from_world[:3, :3], found.cameras[0].cam_from_world[:3, 3]
        return np.concatenate([turn @ center + move, turn @ up])

    expected = seen(shown, choice.center, choice.up)
    np.testing.assert_allclose(seen(result, result.ball.center, result.up), expected, atol=1e-4)
    assert result.ball.radius == pytest.approx(0.9)


def test_a_direction_leans_by_the_angles_asked_for() -> None:
    up = np.array([0.0, 0.6, 0.8])
    np.testing.assert_allclose(tilted(up, 0, 0), up, atol=1e-12)
    assert np.degrees(np.arccos(tilted(up, 30, 0) @ up)) == pytest.approx(30)
    assert np.degrees(np.arccos(tilted(up, 0, -30) @ up)) == pytest.approx(30)
