"""Of two solutions that contradict each other, the one that the photos bear out is taken."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refdgs_pipe.artifacts.placement import Poses
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.sfm import rivals
from refdgs_pipe.sfm.rivals import settled

NONE = np.zeros((0, 3))
MORE = Poses({"IMG_0.png": np.eye(4)}, {}, (), NONE, NONE.astype(np.uint8), {}, 0.5, "global")
MORE = replace(MORE, rival=0.97)
FEWER = replace(MORE, mapper="incremental")
NO_VIEWS = Views(Path(), (), "srgb", "photo")


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> dict[str, bool | None]:
    """What the photos say of the solution of each mapper."""
    said: dict[str, bool | None] = {}
    monkeypatch.setattr(rivals, "shows_the_same", lambda views, poses: said[poses.mapper])
    return said


@pytest.mark.parametrize("right", ["global", "incremental"])
def test_the_solution_that_photos_bear_out_wins_whatever_its_rank(
    shown: dict[str, bool | None], right: str
) -> None:
    """The refuted one is no evidence against it any more."""
    shown |= {"global": right == "global", "incremental": right == "incremental"}
    found = settled(NO_VIEWS, (MORE, FEWER))
    assert found.mapper == right and found.rival is None


@pytest.mark.parametrize("first", [True, False, None])
def test_where_photos_do_not_decide_both_stay_in_doubt(
    shown: dict[str, bool | None], first: bool | None
) -> None:
    for second in {first, None}:
        shown |= {"global": first, "incremental": second}
        assert settled(NO_VIEWS, (MORE, FEWER)) is MORE


def test_solutions_that_agree_are_not_looked_at(shown: dict[str, bool | None]) -> None:
    near = replace(MORE, rival=0.02)
    assert settled(NO_VIEWS, (near, FEWER)) is near
    assert settled(NO_VIEWS, (MORE,)) is MORE
    assert not shown
