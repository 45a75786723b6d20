"""What colours in and round an outline say of each pixel."""

import numpy as np
import pytest
from scenes import orbit

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.ground.shots import Shot
from refdgs_pipe.masking.colours import colour_evidence
from refdgs_pipe.masking.levels import LAST, LEVELS, SHADED

BROWN, WHITE = (0.5, 0.33, 0.2), (0.9, 0.9, 0.88)


def shot_of(rgb: np.ndarray) -> Shot:
    side = len(rgb)
    camera = orbit(1, size=side)[0]
    return Shot(
        camera,
        rgb.astype(np.float32),
        np.ones(rgb.shape[:2], bool),
        (0, side, 0, side),
        (side, side),
    )


def told(strip: tuple[float, ...], shaded: float = SHADED) -> np.ndarray:
    """Evidence of a photo of a white plate on a brown table, with a strip of a colour below it.

    The outline is that of both, as where it has grown over what lies in the plate's shade.
    """
    rgb = np.tile(np.array(BROWN), (120, 120, 1)) + np.random.default_rng(0).normal(
        0, 0.01, (120, 120, 3)
    )
    outline = np.zeros((120, 120), bool)
    outline[40:80, 30:90] = True
    rgb[40:72, 30:90] = WHITE
    rgb[72:80, 30:90] = strip
    shot = shot_of(rgb.clip(0, 1))
    return colour_evidence([shot], [outline.astype(np.float32)], [outline], [3], shaded=shaded)[0]


def test_a_strip_of_shaded_table_inside_the_outline_is_hardly_the_objects() -> None:
    strip = tuple(0.53 * c for c in BROWN)
    value = told(strip)
    assert value[74:78, 40:80].mean() > -0.6
    assert value[45:65, 40:80].mean() < -2
    assert told(strip, shaded=0.0)[74:78, 40:80].mean() < -2


def test_a_dark_foot_of_another_colour_stays_the_objects() -> None:
    value = told((0.1, 0.1, 0.3))
    assert value[74:78, 40:80].mean() < -2


@pytest.mark.parametrize(
    ("light", "share"),
    [
        (None, SHADED),
        (Lighting("world"), SHADED),
        (Lighting("flash"), 0),
        (Lighting("turntable"), 0),
    ],
)
def test_darker_shades_count_in_a_still_light_before_the_last_round(
    light: Lighting | None, share: float
) -> None:
    assert [level.shaded_in(light) for level in (*LEVELS, LAST)] == [share, share, 0]
