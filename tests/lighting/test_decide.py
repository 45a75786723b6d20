"""Which light is found for which evidence."""

import finished
import numpy as np
import pytest
from lighting.test_evidence import ground
from lighting.test_rings import UP, on_table

from refdgs_pipe.lighting.decide import Evidence, decide
from refdgs_pipe.lighting.rings import Rings, find_rings

MODEL = finished.model()


def rings() -> Rings:
    found = find_rings(on_table([(1.0, 2.5, 0)], 12, UP), np.zeros(3), UP)
    assert found is not None
    return found


def kind(
    *,
    turns: bool = False,
    still: float = 0.0,
    slope: float | None = None,
    explained: float | None = None,
    fired: float | None = None,
    wanted: str = "auto",
) -> str:
    evidence = Evidence(rings() if turns else None, still, None, slope, explained, fired)
    return decide(evidence, MODEL, wanted).kind


def test_rings_and_a_still_background_make_a_turntable() -> None:
    assert kind(turns=True, still=0.9, slope=0.0) == "turntable"


def test_rings_alone_may_be_a_camera_on_a_rail() -> None:
    assert kind(turns=True, still=0.02, slope=0.0) == "world"
    assert kind(turns=True) == "world"


@pytest.mark.parametrize(
    ("slope", "fired", "expected"),
    [
        (0.6, None, "flash"),
        (0.2, None, "world"),
        (0.2, 1.0, "flash"),
        (0.02, 1.0, "world"),  # a weak flash in a bright room
        (0.02, 0.0, "world"),
        (None, 1.0, "flash"),  # no ground was seen
        (None, 0.2, "world"),
        (None, None, "world"),
    ],
)
def test_the_ground_decides_on_a_flash_before_exif(
    slope: float | None, fired: float | None, expected: str
) -> None:
    assert kind(slope=slope, fired=fired) == expected


@pytest.mark.parametrize(
    ("slope", "explained", "expected"),
    [
        (0.2, 0.5, "flash"),
        (0.2, 0.1, "world"),  # by chance
        (0.06, 0.5, "world"),  # too weak to matter
        (0.3, 0.1, "flash"),  # under much noise
    ],
)
def test_a_weak_lamp_without_exif_must_explain_the_ground(
    slope: float, explained: float, expected: str
) -> None:
    assert kind(slope=slope, explained=explained) == expected


@pytest.mark.parametrize("wanted", ["world", "turntable", "flash"])
def test_what_was_set_is_done(wanted: str) -> None:
    assert kind(slope=0.6, wanted=wanted) == wanted


def test_a_flash_and_a_room_together_start_with_more_of_the_room() -> None:
    evidence = Evidence(None, 0.0, None, None, None, None)
    shares = [
        light.flash.room
        for light in (decide(evidence, MODEL, k) for k in ("flash", "world+flash"))
        if light.flash is not None
    ]
    assert shares == [0.1, 0.5]


def test_the_lamp_of_a_flash_is_placed_by_the_ground() -> None:
    evidence = Evidence(None, 0.0, ground(1.0, 0.1, (0.0, -0.6)), 0.9, 0.8, None)
    light = decide(evidence, MODEL, "auto")
    assert light.lamp is not None and light.lamp[1] < -0.1


def test_a_turntable_without_rings_turns_about_the_object() -> None:
    light = decide(Evidence(None, 0.0, None, None, None, None), MODEL, "turntable")
    assert light.turntable is not None
    np.testing.assert_array_equal(light.turntable.center, MODEL.ball.center)
    assert len(light.turntable.rings) == 1
