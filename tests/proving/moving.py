"""Light that moves with the camera, or with the room about a turntable."""

from typing import Any

import geom
import numpy as np
import scenes
from common import lookat

ROOM = {"flash": 0.08, "world+flash": 0.5}  # what is left of the room's light
LEVEL = 1.25  # irradiance / pi of the lamp alone on a surface 3.7 away
LAMPS = ([0.0, 0.667, 0.0], [0.2, 0.0, 0.0], [-0.3, 0.4, 0.0])  # from the lens, OpenGL axes
HALF, DISC, TOP = 2.3, 1.35, -0.55  # half width of the square table, radius of the round; height
HEIGHTS = ((16.0, 38.0), (14.0, 32.0, 55.0))  # of the tripod, degrees


def flash(capture: Any, seed: int, room: float) -> dict[str, Any]:
    """Set up the generator's lamp; the less the room is dimmed, the weaker the lamp is.

    Returns:
        What `cameras_gt.json` says about it.
    """
    capture.FLASH.update(offset=LAMPS[seed // 2 % len(LAMPS)], level=LEVEL * (1 - room))
    return {**capture.FLASH, "room_light": room}


def table(texture: np.ndarray, turns: bool, varnish: float | None = None) -> dict[str, Any]:
    """A square table, or a round one that turns, with the texture at the same scale.

    Args:
        varnish: as `Recipe` has it.
    """
    if turns:
        mesh = scenes.disc_base(DISC, TOP - 0.09, TOP, 0.02)
    else:
        mesh = geom.xf(geom.rounded_box((HALF, HALF, 0.06), 0.02), None, (0, 0, TOP - 0.06))
    mesh["UV"] = mesh["V"][:, :2] / (2 * HALF) + 0.5
    if varnish is not None:
        return scenes.obj("table", mesh, type="gloss", base=texture, alpha=varnish)
    return scenes.obj("table", mesh, type="diffuse", base=texture)


def turntable(n: int, rng: np.random.Generator, seed: int) -> list[dict[str, Any]]:
    """Photos from a tripod at two or three heights, in the object's frame.

    The table is turned by hand in about equal steps, once round for each height. Seen from the
    object, camera and room turn together, by `env_azimuth_deg`.
    """
    heights = HEIGHTS[seed // 2 % len(HEIGHTS)]
    start = rng.uniform(0, 2 * np.pi)
    out = []
    for ring, level in enumerate(heights):
        m = n // len(heights) + (ring < n % len(heights))
        azimuth, elevation = start + rng.normal(0, 0.05), np.deg2rad(level + rng.normal(0, 1))
        c = np.cos(elevation)
        eye = np.array([c * np.cos(azimuth), c * np.sin(azimuth), np.sin(elevation)])
        at = np.array([0, 0, -0.22]) + rng.normal(0, 0.04, 3)
        still = lookat(eye * (3.7 + rng.normal(0, 0.15)), at, roll=rng.normal(0, 0.02))
        for k in range(m):
            degrees = 360 * (k + ring / len(heights)) / m + rng.uniform(-2, 2)
            turn = np.eye(4)
            turn[:3, :3] = geom.rot("z", degrees)
            out.append({"c2w": turn @ still, "ring": ring, "env_azimuth_deg": degrees % 360})
    return out
