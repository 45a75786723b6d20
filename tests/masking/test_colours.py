"""What colours in and round an outline say of each pixel."""

import numpy as np
from scenes import orbit

from refdgs_pipe.ground.shots import Shot
from refdgs_pipe.masking.colours import colour_evidence
from refdgs_pipe.masking.levels import SHADED

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


def told(*patches: tuple[slice, tuple[float, ...]], shaded: float = SHADED) -> np.ndarray:
    """Evidence of a photo of a white plate on a brown table, with rows of other colours in it.

    The outline is that of the plate and of the rows below it, as where an outline has grown over
    what lies in the plate's shade.
    """
    rgb = np.tile(np.array(BROWN), (120, 120, 1)) + np.random.default_rng(0).normal(
        0, 0.01, (120, 120, 3)
    )
    outline = np.zeros((120, 120), bool)
    outline[40:80, 30:90] = True
    rgb[40:72, 30:90] = WHITE
    for rows, color in patches:
        rgb[rows, 30:90] = color
    shot = shot_of(rgb.clip(0, 1))
    return colour_evidence([shot], [outline.astype(np.float32)], [outline], [3], shaded=shaded)[0]


def test_a_strip_of_shaded_table_inside_the_outline_is_hardly_the_objects() -> None:
    strip = (slice(72, 80), tuple(0.53 * c for c in BROWN))
    value = told(strip)
    assert value[74:78, 40:80].mean() > -0.6
    assert value[45:65, 40:80].mean() < -2
    assert told(strip, shaded=0.0)[74:78, 40:80].mean() < -2


def test_a_dark_foot_of_another_colour_stays_the_objects() -> None:
    value = told((slice(72, 80), (0.1, 0.1, 0.3)))
    assert value[74:78, 40:80].mean() < -2
