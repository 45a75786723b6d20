"""Where surfels start when photos without masks were taken from one side."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.geometry import one_sided
from refdgs_pipe.training.ground import Surroundings
from refdgs_pipe.training.initial import Cloud, neighbour_sizes
from refdgs_pipe.training.photos import TrainingPhoto
from refdgs_pipe.training.settings import StartParams

Progress = Callable[[int, int], None]

LEAST = 0.1  # of the pixels of the mean photo, that show what photos agree on in the ball
BEHIND = 0.5  # of the background's surfels at most, to start with
_FILE = "stereo.safetensors"


def agreed_cloud(
    params: StartParams,
    model: SparseModel,
    photos: list[TrainingPhoto],
    scratch: Path,
    progress: Progress | None = None,
) -> Cloud | None:
    """Discs on what the photos agree on, or None where the object is to be looked for.

    What was found stays in `scratch`.

    Args:
        photos: on the CPU, without masks.
        progress: told the photos done and their number; may raise.
    """
    one_side = one_sided(model.cameras, model.ball.center, model.up)
    if params.unmasked == "look" or (params.unmasked == "auto" and not one_side):
        return None
    kept = scratch / _FILE
    if not kept.is_file():
        _keep(kept, params, model, photos, progress)
    tensors = load_file(kept)
    if not len(tensors["points"]):
        return None
    points, normals, colors, sizes = (
        tensors[name].numpy() for name in ("points", "normals", "colors", "sizes")
    )
    return Cloud(points, normals, sizes, colors)


def _keep(
    path: Path,
    params: StartParams,
    model: SparseModel,
    photos: list[TrainingPhoto],
    progress: Progress | None,
) -> None:
    """Compare the photos, and write what was found; no points, if that is too little."""
    from refdgs_pipe.training.stereo import agreed_surface, thinned

    found = agreed_surface(model, photos, torch.get_num_threads(), progress)
    around = Surroundings(model, ground=params.ground == "background")
    own = around.objects(torch.from_numpy(found.points)).numpy()
    pixels = sum(seen.size for seen in found.seen)
    enough = own.sum() >= LEAST * pixels
    parts = [
        thinned(found, own, params.surfels),
        thinned(found, ~own, round(BEHIND * params.background_surfels)),
    ]
    names = ("points", "normals", "colors")
    tensors = {
        name: np.concatenate([part[k] for part in parts])[: None if enough else 0]
        for k, name in enumerate(names)
    }
    sizes = [neighbour_sizes(part[0]) for part in parts]
    tensors["sizes"] = np.concatenate(sizes)[: None if enough else 0]
    part = path.with_suffix(".part")
    save_file({name: torch.from_numpy(array.copy()) for name, array in tensors.items()}, part)
    part.replace(path)
