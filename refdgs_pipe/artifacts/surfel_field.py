"""A trained Ref-DGS field on disk: safetensors for us, a 2DGS PLY for viewers is made at export."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from refdgs_pipe.artifacts.lighting import WORLD, Lighting
from refdgs_pipe.artifacts.sparse_model import Ball
from refdgs_pipe.errors import CorruptError

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
_SHAPES = {"means": 3, "quats": 4, "scales": 2, "opacities": 0}


@dataclass(frozen=True)
class SurfelSet:
    """One set of 2-D Gaussians, world units.

    Args:
        means: (N, 3).
        quats: (N, 4) unit, w x y z.
        scales: (N, 2) standard deviations.
        opacities: (N,) in (0, 1).
        values: what each carries, name -> (N, C): diffuse (linear) and roughness; features; or
            sh, (N, 3 K) spherical harmonics of the sRGB colour, coefficient-major.
    """

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    values: dict[str, F32]

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True)
class ShaderModel:
    """How features become specular radiance.

    Args:
        reflection, local, mixing, physical: the switches it was trained with.
        environment: (H, W, 4) Sph-Mip base map.
        weights, biases: of the MLP's layers, each (out, in) and (out,).
        flash: (h, 2h, 4) Sph-Mip base map in the camera's frame; None without a flash.
    """

    reflection: bool
    local: str
    mixing: str
    physical: bool
    environment: F32
    weights: tuple[F32, ...]
    biases: tuple[F32, ...]
    flash: F32 | None = None


@dataclass(frozen=True)
class SurfelField:
    """Everything needed to draw the scene.

    Args:
        geometry: carries diffuse and roughness (and features when local is "shared").
        local: carries features; empty unless local is "dual".
        background: carries sh; empty when the photos' background was removed.
        near: depth before which nothing is drawn, world units.
        poses: camera's name -> (4, 4) cam_from_world that it was trained with, where that is not
            the sparse model's; see `SparseModel.placed`.
        ball: that it was trained in; None, if that is the sparse model's.
        lighting: how the light moves from photo to photo, as it was fitted.
    """

    geometry: SurfelSet
    local: SurfelSet
    background: SurfelSet
    shader: ShaderModel
    near: float
    poses: Mapping[str, F64] = field(default_factory=dict)
    ball: Ball | None = None
    lighting: Lighting = WORLD

    def save(self, folder: Path) -> None:
        from safetensors.numpy import save_file

        arrays: dict[str, F32] = {"environment": self.shader.environment}
        for name, part in self._sets().items():
            for kind in _SHAPES:
                arrays[f"{name}.{kind}"] = getattr(part, kind)
            arrays |= {f"{name}.values.{k}": v for k, v in part.values.items()}
        for i, (w, b) in enumerate(zip(self.shader.weights, self.shader.biases, strict=True)):
            arrays[f"shader.{i}.weight"], arrays[f"shader.{i}.bias"] = w, b
        if self.shader.flash is not None:
            arrays["flash"] = self.shader.flash
        contiguous = {k: np.ascontiguousarray(v, np.float32) for k, v in arrays.items()}
        save_file(contiguous, folder / "field.safetensors")
        record = {
            "reflection": self.shader.reflection,
            "local": self.shader.local,
            "mixing": self.shader.mixing,
            "physical": self.shader.physical,
            "near": self.near,
            "layers": len(self.shader.weights),
            "poses": {name: pose.tolist() for name, pose in self.poses.items()},
            "lighting": self.lighting.record(),
        }
        if self.ball is not None:
            record["ball"] = {"center": self.ball.center.tolist(), "radius": self.ball.radius}
        (folder / "field.json").write_text(json.dumps(record, indent=2), "utf-8")

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read a field.

        Raises:
            CorruptError: files are missing, damaged or do not fit together.
        """
        from safetensors import SafetensorError
        from safetensors.numpy import load_file

        try:
            arrays = load_file(folder / "field.safetensors")
            record = json.loads((folder / "field.json").read_text("utf-8"))
            layers = range(record["layers"])
            shader = ShaderModel(
                record["reflection"],
                record["local"],
                record["mixing"],
                record["physical"],
                arrays["environment"],
                tuple(arrays[f"shader.{i}.weight"] for i in layers),
                tuple(arrays[f"shader.{i}.bias"] for i in layers),
                arrays.get("flash"),
            )
            geometry, local, background = (
                _set(arrays, name) for name in ("geometry", "local", "background")
            )
            poses = {name: _pose(rows) for name, rows in record.get("poses", {}).items()}
            ball = _ball(record["ball"]) if "ball" in record else None
            light = Lighting.of(record["lighting"]) if "lighting" in record else WORLD
            near = float(record["near"])
            return cls(geometry, local, background, shader, near, poses, ball, light)
        except (OSError, KeyError, TypeError, ValueError, SafetensorError) as error:
            raise CorruptError(
                f"{folder}: not a readable surfel field ({error}): run the stage refine again"
            ) from error

    def _sets(self) -> dict[str, SurfelSet]:
        return {"geometry": self.geometry, "local": self.local, "background": self.background}


def _ball(record: dict[str, Any]) -> Ball:
    center, radius = np.array(record["center"], np.float64), float(record["radius"])
    if center.shape != (3,) or not (np.isfinite(center).all() and 0 < radius < np.inf):
        raise ValueError("the ball is no ball")
    return Ball(center, radius)


def _pose(rows: list[list[float]]) -> F64:
    pose = np.array(rows, np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("a pose is not 4 x 4 finite numbers")
    return pose


def _set(arrays: dict[str, F32], name: str) -> SurfelSet:
    parts = {kind: arrays[f"{name}.{kind}"] for kind in _SHAPES}
    n = len(parts["means"])
    prefix = f"{name}.values."
    values = {k[len(prefix) :]: v for k, v in arrays.items() if k.startswith(prefix)}
    for kind, width in _SHAPES.items():
        if parts[kind].shape != ((n, width) if width else (n,)):
            raise ValueError(f"{name}.{kind} is {parts[kind].shape} for {n} surfels")
    for kind, array in [*parts.items(), *values.items()]:
        if len(array) != n or not np.isfinite(array).all():
            raise ValueError(f"{name}.{kind} has the wrong length or is not finite")
    return SurfelSet(**parts, values=values)
