"""Evidence is no more than what a capture's own pixels bear out."""

import numpy as np
import pytest

from refdgs_pipe.camera import Camera
from refdgs_pipe.ground.shots import Shot
from refdgs_pipe.masking.odds import calibrated
from refdgs_pipe.masking.table import LIMIT, Evidence

SIDE = 60
INNER = np.zeros((SIDE, SIDE), bool)
INNER[20:40, 20:40] = True


def plain_shot() -> Shot:
    K = np.array([[100.0, 0, 30], [0, 100, 30], [0, 0, 1]])
    rgb = np.full((SIDE, SIDE, 3), 0.5, np.float32)
    box = (0, SIDE, 0, SIDE)
    return Shot(Camera("p", SIDE, SIDE, K, np.eye(4)), rgb, np.ones_like(INNER), box, (SIDE, SIDE))


def told(inside: float, outside: float, known: np.ndarray | None = None) -> np.ndarray:
    """The evidence after, where it was `inside` on the object and `outside` elsewhere."""
    value = np.where(INNER, np.float32(inside), np.float32(outside))
    evidence = Evidence(value, np.ones_like(INNER) if known is None else known)
    shots, parts = [plain_shot()] * 3, ([INNER] * 3, [~INNER] * 3)
    return calibrated([evidence] * 3, shots, *parts)[1].value


def test_what_is_met_everywhere_tells_nothing() -> None:
    assert np.abs(told(1.0, 1.0)).max() < 0.2


def test_what_is_met_only_outside_keeps_its_value() -> None:
    new = told(-1.0, LIMIT)
    assert np.allclose(new[INNER], -1.0)
    assert np.allclose(new[~INNER], LIMIT)


def test_evidence_never_changes_its_sign() -> None:
    new = told(1.5, -1.5)  # the wrong way round
    assert np.abs(new).max() == 0


def test_what_is_not_known_stays_nothing() -> None:
    known = np.zeros_like(INNER)
    assert np.abs(told(-1.0, 2.5, known)).max() == 0


def test_with_few_pixels_evidence_stays_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("refdgs_pipe.masking.odds.LEAST_PIXELS", 10**6)
    assert np.allclose(told(1.0, 1.0), 1.0)
