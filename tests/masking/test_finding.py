"""Which explanation of the foot the masks are made by."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.masking import finding
from refdgs_pipe.masking.finding import agreement, object_masks
from refdgs_pipe.masking.foot import Foot
from refdgs_pipe.masking.rounds import ROUNDS, Found

BALL = Ball(np.zeros(3), 1.0)
DOUBTFUL = np.eye(4, dtype=bool)


def found(same: int) -> Found:
    """Masks of 1000 pixels, of which so many agree with the solid."""
    mask, outline = np.ones((1, 1000), np.float32), np.arange(1000)[None] < same
    return Found([mask], [outline], None, 1.0, BALL)


def chosen(
    monkeypatch: pytest.MonkeyPatch, free: Found | None, standing: Found | None, foot: Foot
) -> tuple[Found | None, list[tuple[int, int]]]:
    """What is found, and the progress that is told."""

    def solved(
        views: Any, model: Any, plane: Any, stands: Foot, begins: Callable[[], None], **more: Any
    ) -> Found | None:
        for _ in range(ROUNDS):
            begins()
        return free if stands.covered is None else standing

    monkeypatch.setattr(finding, "foot", lambda *a, **k: foot)
    monkeypatch.setattr(finding, "solved", solved)
    told: list[tuple[int, int]] = []
    nothing: Any = None
    plane = (np.array([0, 0, 1.0]), 0.0)
    out = object_masks(nothing, nothing, plane, lambda *at: told.append(at))
    return out, told


@pytest.mark.parametrize(
    ("free", "standing", "wins"), [(950, 953, 950), (950, 960, 960), (960, 930, 960)]
)
def test_a_foot_without_proof_has_to_make_the_masks_agree_better(
    monkeypatch: pytest.MonkeyPatch, free: int, standing: int, wins: int
) -> None:
    foot = Foot([], unproven=DOUBTFUL, radius=1.0)
    out, told = chosen(monkeypatch, found(free), found(standing), foot)
    assert out is not None
    assert agreement(out)[0] == pytest.approx(wins / 1000)
    assert told[-1] == (2 * ROUNDS - 1, 2 * ROUNDS)
    assert [done for done, _ in told] == sorted(done for done, _ in told)


def test_what_only_one_explanation_finds_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    foot = Foot([], unproven=DOUBTFUL, radius=1.0)
    for pair in ((None, found(900)), (found(900), None)):
        assert chosen(monkeypatch, *pair, foot)[0] in pair
    assert chosen(monkeypatch, None, None, foot)[0] is None


def test_a_foot_without_doubt_is_solved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    out, told = chosen(monkeypatch, found(950), found(990), Foot([]))
    assert out is not None and agreement(out)[0] == pytest.approx(0.95)
    assert told[-1] == (ROUNDS - 1, ROUNDS)


def test_what_is_doubtful_joins_what_is_covered() -> None:
    covered = np.fliplr(DOUBTFUL)
    both = Foot([], covered, 1.0, unproven=DOUBTFUL).on_unproven()
    assert both.covered is not None and both.unproven is None
    np.testing.assert_array_equal(both.covered, covered | DOUBTFUL)
