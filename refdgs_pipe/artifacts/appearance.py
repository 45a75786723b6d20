"""What a surface is made of, told apart from the light that fell on it."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.lighting import WORLD, Lighting
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.ground_light import GroundLight

F32 = NDArray[np.float32]
_PER_POINT = {
    "points": 3,
    "roughness": 0,
    "metallic": 0,
    "tint": 3,
    "gain": 3,
    "received": 3,
    "openness": 0,
}
_GROUND = "ground.safetensors"


@dataclass(frozen=True)
class Appearance:
    """The materials of a mesh, one for each of its V vertices, and the light around it.

    Args:
        points: (V, 3) the vertices, world.
        roughness: (V,) as in glTF: the square root of the GGX alpha.
        metallic: (V,) 0 to 1.
        tint: (V, 3) linear reflectance where it is metal.
        gain: (V, 3) factor of the field's diffuse radiance.
        received: (V, 3) linear radiance that a white matte surface would show there; the base
            colour of what is not metal is diffuse * gain / received.
        openness: (V,) share of the light from all sides that nothing of the object is in front
            of, weighted by the cosine: ambient occlusion.
        environment: (H, 2H, 3) linear radiance, laid out as `refdgs_pipe.light` says; None for a
            field without reflections. Where light moves: in the frame where it stands still, a
            turntable's room or the world; without the flash.
        lighting: how it moves.
        white: linear radiance of a white matte surface that faces a flash at its `distance`; 0
            without one.
        ground: the light below the object, as photos show it; None where they do not tell it.
    """

    points: F32
    roughness: F32
    metallic: F32
    tint: F32
    gain: F32
    received: F32
    openness: F32
    environment: F32 | None
    lighting: Lighting = WORLD
    white: float = 0.0
    ground: GroundLight | None = None

    def save(self, folder: Path) -> None:
        from safetensors.numpy import save_file

        arrays = {name: getattr(self, name) for name in _PER_POINT}
        if self.environment is not None:
            arrays["environment"] = self.environment
        contiguous = {k: np.ascontiguousarray(v, np.float32) for k, v in arrays.items()}
        save_file(contiguous, folder / "appearance.safetensors")
        record = {
            "points": len(self.points),
            "lit": self.environment is not None,
            "lighting": self.lighting.record(),
            "white": self.white,
        }
        if self.ground is not None:
            own = self.ground
            save_file({"picture": own.picture.astype(np.float16)}, folder / _GROUND)
            axes = {name: getattr(own, name).tolist() for name in ("origin", "a", "b")}
            record["ground"] = {**axes, "radius": float(own.radius)}
        (folder / "appearance.json").write_text(json.dumps(record), "utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            CorruptError: a file is missing, damaged, or does not fit.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        try:
            arrays = load_file(folder / "appearance.safetensors")
            count = len(arrays["points"])
            for name, width in _PER_POINT.items():
                shape = (count, width) if width else (count,)
                if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
                    raise ValueError(f"{name} has the wrong shape or is not finite")
            light = arrays.get("environment")
            if light is not None and light.shape != (len(light), 2 * len(light), 3):
                raise ValueError(f"environment is {light.shape}")
            record = json.loads((folder / "appearance.json").read_text("utf-8"))
            moving = Lighting.of(record["lighting"]) if "lighting" in record else WORLD
            own, white = {name: arrays[name] for name in _PER_POINT}, float(record.get("white", 0))
            ground = _ground(folder, record["ground"]) if "ground" in record else None
            return cls(**own, environment=light, lighting=moving, white=white, ground=ground)
        except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
            raise CorruptError(
                f"{folder}: not a readable appearance ({error}): run the stage appearance again"
            ) from error


def _ground(folder: Path, record: dict[str, Any]) -> GroundLight:
    """The light below, as `Appearance.save` wrote it."""
    from safetensors.numpy import load_file

    picture = load_file(folder / _GROUND)["picture"].astype(np.float32)
    origin, a, b = axes = [np.asarray(record[n], np.float64) for n in ("origin", "a", "b")]
    radius = float(record["radius"])
    finite = all(axis.shape == (3,) and np.isfinite(axis).all() for axis in axes)
    if picture.shape != (len(picture), len(picture), 4) or len(picture) < 2:
        raise ValueError(f"the ground is {picture.shape}")
    if not (finite and np.isfinite(picture).all() and 0 < radius < np.inf):
        raise ValueError("the ground has values that are not finite")
    return GroundLight(picture, origin, a, b, radius)
