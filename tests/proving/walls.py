"""A room with walls that stand at a distance, in place of surroundings infinitely far away."""

from typing import Any

import capture
import drjit as dr
import mitsuba as mi
import numpy as np

METRE = 1 / 0.15  # in scene units
HALF, EYE, TOP = (2.6, 2.2), 1.25, 3.0  # metres; as the generator draws its rooms
SIDES = [  # inward normal, along u, along v
    ((-1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 0, -1), (1, 0, 0), (0, 1, 0)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
]
PIXELS = 2048  # of each side's texture
# Someone who holds the camera: half sizes and middle of boxes (to the right, away from the object,
# up), in metres from the camera; and the light that they send out, where the walls' is about 0.5
BODY = [
    ((0.08, 0.012, 0.05), (0.0, 0.03, 0.0), (0.2, 0.14, 0.11)),  # hands and telephone
    ((0.08, 0.09, 0.12), (0.0, 0.28, 0.06), (0.25, 0.18, 0.14)),  # head
    ((0.22, 0.12, 0.3), (0.0, 0.4, -0.38), (0.07, 0.09, 0.15)),  # shirt
    ((0.16, 0.12, 0.42), (0.0, 0.42, -1.1), (0.03, 0.03, 0.035)),  # trousers
]


class WalledTracer(capture.PhotoTracer):
    """Traces photos inside a room of walls that shine with the light of a drawn room.

    Args:
        surroundings: (H, W, 3) the room as seen from its middle, as `env.build` draws it.
        inside: (x, y) where the object stands, metres from the middle.
        someone: whether someone holds the camera: objects mirror them, and they shade the room.
    """

    def __init__(
        self,
        objects: list[dict[str, Any]],
        surroundings: np.ndarray,
        width: int,
        height: int,
        fov: float,
        inside: tuple[float, float],
        someone: bool = False,
    ) -> None:
        self.flash = False
        dark = {"dark": {"type": "constant", "radiance": 1e-7}}
        shining, painted = _walls(surroundings, inside)
        for k, (_, _, light) in enumerate(BODY if someone else []):
            shining[f"body{k}"], painted[f"body{k}"] = _box(light)
        super(capture.PhotoTracer, self).__init__(
            objects, None, width, height, fov, {**dark, **shining}
        )
        cube = mi.traverse(mi.load_dict({"type": "cube"}))
        self._cube = np.array(cube["vertex_positions"]).reshape(-1, 3)
        shapes = {f"s{k:02d}": shape for k, shape in enumerate(self.shapes)}
        self._painted = mi.load_dict({"type": "scene", **dark, **painted, **shapes})

    def place(self, cam: dict[str, Any]) -> None:
        """Whoever holds the camera moves with it; they stand upright and face the object."""
        eye = np.asarray(cam["c2w"])[:3, 3]
        away = np.array([*eye[:2], 0.0]) / max(float(np.hypot(*eye[:2])), 1e-6)
        axes = np.stack([np.cross(away, [0, 0, 1.0]), away, [0, 0, 1.0]])
        for scene in (self.scene, self._painted):
            params = mi.traverse(scene)
            for k, (half, middle, _) in enumerate(BODY):
                key = f"body{k}.vertex_positions"
                if key in params:
                    corners = self._cube * half + middle
                    place = eye + METRE * corners @ axes
                    params[key] = mi.Float(place.astype(np.float32).ravel())
            params.update()

    def features(self, *args: Any, **options: Any) -> Any:
        """The denoiser's features, with the walls' light as their colour."""
        lamps, scene = self.t_lamp, self.scene
        self.t_lamp, self.scene = None, self._painted
        count = 1 + max(_number(shape) for shape in [*scene.shapes(), *self._painted.shapes()])
        tables = self.t_metal, self.t_rough, self.t_F0
        self.t_metal, self.t_rough = _longer(tables[0], count, 0), _longer(tables[1], count, 1)
        self.t_F0 = [_longer(one, count, 0) for one in tables[2]]
        try:
            return super().features(*args, **options)
        finally:
            self.t_lamp, self.scene = lamps, scene
            self.t_metal, self.t_rough, self.t_F0 = tables


def _walls(
    surroundings: np.ndarray, inside: tuple[float, float]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The six sides of the room: as lamps, and painted in the colour of their light."""
    middle = -METRE * np.array([*inside, 0.0])
    size = METRE * np.array([*HALF, TOP / 2])
    centre = METRE * np.array([0, 0, TOP / 2 - EYE])  # of the box, from the middle at eye's height
    h, w = surroundings.shape[:2]
    s = (np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1
    shining, painted = {}, {}
    for k, (normal, u, v) in enumerate(np.array(SIDES, float)):
        at = centre - normal * size
        along, up = u * (u @ size), v * (v @ size)
        d = at + s[None, :, None] * along + s[:, None, None] * up
        d /= np.linalg.norm(d, axis=-1, keepdims=True)
        column = np.arctan2(d[..., 0], d[..., 1]) / (2 * np.pi) % 1 * w
        row = np.arccos(np.clip(d[..., 2], -1, 1)) / np.pi * h
        light = surroundings[
            np.clip(row.astype(int), 0, h - 1), np.clip(column.astype(int), 0, w - 1)
        ]
        turned = np.eye(4)
        turned[:3, 0], turned[:3, 1], turned[:3, 3] = along, up, at + middle
        turned[:3, 2] = normal if np.linalg.det(np.stack([u, v, normal], 1)) > 0 else -normal
        if turned[:3, 2] @ normal < 0:  # the lamp shines to the inside only
            turned[:3, 0] *= -1
            turned[:3, 2] *= -1
            light = light[:, ::-1]
        side = {"type": "rectangle", "to_world": mi.ScalarTransform4f(turned)}
        black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
        emitter = {"type": "area", "radiance": capture.bitmap(light)}
        shining[f"wall{k}"] = {**side, "bsdf": black, "emitter": emitter}
        paint = np.clip(light / (light + 1) * 1.3, 0, 1)
        painted[f"wall{k}"] = {
            **side,
            "bsdf": {"type": "diffuse", "reflectance": capture.bitmap(paint)},
        }
    return shining, painted


def _box(light: tuple[float, float, float]) -> tuple[dict[str, Any], dict[str, Any]]:
    """A part of a body: as a lamp, and painted in the colour of its light."""
    colour = {"type": "rgb", "value": list(light)}
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    shining = {"type": "cube", "bsdf": black, "emitter": {"type": "area", "radiance": colour}}
    return shining, {"type": "cube", "bsdf": {"type": "diffuse", "reflectance": colour}}


def _number(shape: Any) -> int:
    """The shape's index in the tracer's tables."""
    return int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0])


def _longer(table: Any, count: int, value: float) -> Any:
    """The table with a value for shapes that it does not have yet."""
    old = np.array(table)
    return mi.Float(np.append(old, np.full(max(0, count - len(old)), value)).astype(np.float32))
