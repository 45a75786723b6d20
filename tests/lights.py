"""Lightings of all kinds, for tests."""

import numpy as np

from refdgs_pipe.artifacts.lighting import BANDS, WORLD, Flash, Lighting, Ring, Turntable

AXIS = np.array([0.0, 0.0, 1.0])
RINGS = (Ring(1.0, 3.0), Ring(2.0, 2.0))
LIGHTS = {
    "world": WORLD,
    "turntable": Lighting(
        "turntable", turntable=Turntable(np.zeros(3), AXIS, RINGS, np.zeros((BANDS, 3)))
    ),
    "flash": Lighting("flash", flash=Flash(np.array([0.0, -0.2, 0]), 3.0, 0.2)),
}
