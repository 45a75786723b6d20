"""The ball and the up direction that a user chose by hand, as settings of the stage `gate`."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.sfm.frame import z_from_up
from refdgs_pipe.viewing.contents import Scene

F64 = NDArray[np.float64]
_SAME = 1e-4  # of the ball's radius, and of a direction: what is nearer is the same


@dataclass(frozen=True)
class Choice:
    """What was chosen, in the frame of the view.

    Args:
        center: (3,), radius: of the object ball, world units.
        up: (3,) unit vector, world.
    """

    center: F64
    radius: float
    up: F64

    @classmethod
    def of(cls, model: SparseModel) -> "Choice":
        """As the model has it."""
        return cls(model.ball.center, model.ball.radius, model.up)


def assignments(scene: Scene, choice: Choice) -> list[str]:
    """The `gate.KEY=VALUE` that make a choice, of what differs from the scene.

    Settings are meant in the frame before `gate.up` turned it: the world of photos is turned so
    that up is z, that of known poses is not. With a setting of its own, the frame of the view is
    turned back. A choice of another up axis needs the ball too, if one was chosen.
    """
    model, back = scene.model, _settings_from_view(scene)
    found = []
    near = _SAME * model.ball.radius
    if np.linalg.norm(choice.center - model.ball.center) > near:
        found.append(f"gate.ball_center={_vector(back @ choice.center)}")
    if abs(choice.radius - model.ball.radius) > near:
        found.append(f"gate.ball_radius={_number(choice.radius)}")
    up = choice.up / max(float(np.linalg.norm(choice.up)), 1e-12)
    if np.linalg.norm(up - model.up) > _SAME:
        found.append(f"gate.up={_vector(back @ up)}")
    return found


def tilted(up: F64, along_x: float, along_y: float) -> F64:
    """(3,) a direction that leans from `up` by two angles in degrees, about two level axes."""
    turn = z_from_up(up).T
    a, b = math.radians(along_x), math.radians(along_y)
    leaning = np.array([math.tan(a), math.tan(b), 1.0])
    return np.asarray(turn @ (leaning / np.linalg.norm(leaning)))


def _settings_from_view(scene: Scene) -> F64:
    """(3, 3) rotation into the frame in which the settings are meant."""
    is_known = np.array_equal(scene.model.sfm_from_world, np.eye(4))
    if scene.set_up is None or is_known:
        return np.eye(3)
    up = np.array(scene.set_up, float)
    return z_from_up(up / np.linalg.norm(up)).T


def _vector(values: F64) -> str:
    return f"[{', '.join(_number(v) for v in values)}]"


def _number(value: float) -> str:
    """Six digits; what is next to nothing is 0."""
    return f"{round(float(value), 6) + 0.0:.6g}"
