"""The field in a checkpoint, to be looked at while its training goes on."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from refdgs_pipe.artifacts.lighting import Lighting
from refdgs_pipe.artifacts.surfel_field import ShaderModel, SurfelField, SurfelSet
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.training.moving_light import moving
from refdgs_pipe.training.surfels import TrainableSet, array

_FEATURES = 4  # channels of each map that the shader's network reads


def unfinished_field(path: Path, near: float, lighting: Lighting) -> SurfelField:
    """The field as a checkpoint of `train` or `refine` has it, without refined poses.

    The switches of the shader are not in the checkpoint. They show in which tensors there are, and
    in how many inputs the network has: 4 for each map, 2 more where it is told roughness and angle.
    What has no moments of the optimiser yet takes no part in the picture yet.

    Args:
        near: depth before which nothing is drawn, world units.
        lighting: that the training began with.

    Raises:
        CorruptError: the file is missing, damaged, or no such checkpoint.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            names = list(file.keys())
            tensors = {name: file.get_tensor(name) for name in names if _is_drawn(name, names)}
        geometry = _set(tensors, "geometry")
        local, behind = _set(tensors, "local"), _set(tensors, "background")
        shader = _shader(tensors, "features" in geometry.values)
        light = _light(tensors, lighting)
        return SurfelField(geometry, local, behind, shader, near, lighting=light)
    except (SafetensorError, OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise CorruptError(f"{path}: not a readable checkpoint ({error})") from None


def _is_drawn(name: str, names: list[str]) -> bool:
    """Whether a tensor is part of the picture: no moments, no statistics, nothing untouched."""
    part, _, rest = name.partition("/")
    if part == "shader":
        return any(other.startswith("shader-adam/") for other in names)
    if part == "local" and rest.startswith("raw."):
        return any(other.startswith("local/adam.") for other in names)
    return part == "light" or rest.startswith("raw.")


def _set(tensors: dict[str, Tensor], name: str) -> SurfelSet:
    """A set of surfels; an empty one if the field has none of that name."""
    prefix = f"{name}/raw."
    raw = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    if not raw and name != "geometry":
        shapes = ((0, 3), (0, 4), (0, 2), (0,))
        means, quats, scales, opacities = (np.zeros(s, np.float32) for s in shapes)
        return SurfelSet(means, quats, scales, opacities, {})
    return TrainableSet(raw, dict.fromkeys(raw, 0.0)).freeze()


def _shader(tensors: dict[str, Tensor], is_shared: bool) -> ShaderModel:
    if "shader/environment" not in tensors:
        nothing = np.zeros((0, 0, 4), np.float32)
        return ShaderModel(False, "none", "adaptive", False, nothing, (), ())
    count = sum(name.startswith("shader/weights.") for name in tensors)
    weights = tuple(array(tensors[f"shader/weights.{i}"]) for i in range(count))
    biases = tuple(array(tensors[f"shader/biases.{i}"]) for i in range(count))
    flash = tensors.get("shader/flash")
    more = weights[0].shape[1] - _FEATURES * (1 if flash is None else 2)
    local = "dual" if "local/raw.means" in tensors else "shared" if is_shared else "none"
    return ShaderModel(
        reflection=True,
        local=local,
        mixing="adaptive" if more >= _FEATURES else "sum",
        physical=more % _FEATURES == 2,
        environment=array(tensors["shader/environment"]),
        weights=weights,
        biases=biases,
        flash=None if flash is None else array(flash),
    )


def _light(tensors: dict[str, Tensor], lighting: Lighting) -> Lighting:
    light = moving(lighting)
    if light is None:
        return lighting
    with torch.no_grad():
        for name, parameter in light.named_parameters():
            parameter.copy_(tensors[f"light/{name}"])
    return light.freeze()
