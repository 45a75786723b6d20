"""What a run needs of a GPU's memory, and smaller settings where there is less."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.errors import DeviceError
from refdgs_pipe.training.settings import TrainParams
from refdgs_pipe.training.trainer import Progress, Trainer

# Bytes, counted from the tensors that live at once in a step: torch and its kernels; maps, shading
# and their gradients for a pixel; parameters, Adam, records and 8 entries of 150 for a surfel; a
# number of the Sph-Mip map with Adam, mips and its gradient in whole numbers. Recorded steps have
# pixels' and surfels' memory of their own.
FIXED, PER_PIXEL, PER_SURFEL, PER_MAP_NUMBER = 700_000_000, 800, 2000, 32
SPARE = 0.9  # share of the free memory that is planned with; the rest is lost between blocks
LEAST_SIDE, LEAST_SURFELS = 256, 5000
SMALLER_SIDE, FEWER_SURFELS = 0.85, 0.75
TRIES = 6
CAPS = ("surfels", "max_surfels", "local_surfels", "max_local_surfels", "background_surfels")


@dataclass(frozen=True)
class Load:
    """What a GPU is asked to do.

    Args:
        cuda_graph: whether recorded steps are repeated; None: where they prove equal.
    """

    params: TrainParams
    cuda_graph: bool | None = None


@dataclass(frozen=True)
class Need:
    """Bytes of GPU memory by what asks for them."""

    pixels: int
    surfels: int
    fixed: int

    @property
    def total(self) -> int:
        """Their sum."""
        return self.pixels + self.surfels + self.fixed


def need_of(load: Load, model: SparseModel) -> Need:
    """What training takes at its largest."""
    params = load.params
    cameras = [camera for camera in model.cameras if camera.split == "train"]
    sizes = []
    for camera in cameras:
        scale = min(1.0, params.max_side / max(camera.width, camera.height))
        sizes.append(camera.width * camera.height * scale * scale)
    kept = sum(sizes) * 5 * (1 + params.coarse**2)  # RGB, mask and validity, at two scales
    surfels = params.most_surfels + params.background_surfels
    if params.reflection and params.local == "dual":
        surfels += params.max_local_surfels
    numbers = params.environment_height**2 * 2 * 4 if params.reflection else 0
    times = 1 if load.cuda_graph is False else 2
    return Need(
        int(kept + times * max(sizes, default=0.0) * PER_PIXEL),
        times * surfels * PER_SURFEL,
        FIXED + numbers * PER_MAP_NUMBER,
    )


def fitted(load: Load, model: SparseModel, budget: int) -> Load:
    """The load, made smaller until it needs no more than `budget` bytes.

    Steps are no longer recorded, unless they must be; then whichever of pixels and surfels takes
    more is lowered first.

    Raises:
        DeviceError: even the smallest settings need more.
    """
    while (need := need_of(load, model)).total > budget:
        smaller = _unrecorded(load)
        if smaller == load:
            smaller = _smaller(load, pixels=need.pixels >= need.surfels)
        if smaller == load:
            raise DeviceError(
                f"training needs at least {need.total / 1e9:.1f} GB of GPU memory and may use "
                f"{budget / 1e9:.1f} GB: give more by --vram, free the GPU, or use --device cpu"
            )
        load = smaller
    return load


def planned(load: Load, model: SparseModel, *, vram: int, warn: Callable[[str], None]) -> Load:
    """A load that fits the GPU's free memory and `vram` bytes (0: no limit); says what changed.

    Raises:
        DeviceError: nothing fits.
    """
    budget = int(SPARE * torch.cuda.mem_get_info()[0])
    budget = min(budget, vram) if vram else budget
    fitting = fitted(load, model, budget)
    if fitting != load:
        warn(f"{budget / 1e9:.1f} GB of GPU memory: {changes(load, fitting)}")
    return fitting


def train_within(
    make: Callable[[Load], Trainer],
    load: Load,
    progress: Progress,
    warn: Callable[[str], None],
) -> tuple[Trainer, SurfelField]:
    """Train; where the GPU's memory runs out, go on from the last checkpoint with smaller settings.

    Raises:
        DeviceError: it runs out with the smallest settings too.
    """
    for turn in range(TRIES):
        try:
            trainer = make(load)
            return trainer, trainer.run(progress)
        except torch.cuda.OutOfMemoryError:
            smaller = _smaller(_smaller(load, pixels=turn % 2 == 0), pixels=turn % 2 == 0)
            smaller = _unrecorded(smaller)
        # after the except clause: until its end the failed step's tensors are alive
        torch.cuda.empty_cache()
        if smaller == load:
            break
        warn(f"the GPU's memory ran out: {changes(load, smaller)}")
        load = smaller
    params = load.params
    raise DeviceError(
        f"the GPU's memory runs out even at {params.max_side} pixels and {params.max_surfels} "
        "surfels: free the GPU, or use --device cpu"
    )


def changes(before: Load, after: Load) -> str:
    """What differs, in words."""
    old, new, parts = before.params, after.params, []
    if new.max_side != old.max_side:
        parts.append(f"training at {new.max_side} instead of {old.max_side} pixels")
    if new.max_surfels != old.max_surfels:
        parts.append(f"at most {new.max_surfels} instead of {old.max_surfels} surfels")
    if after.cuda_graph != before.cuda_graph:
        parts.append("steps are not recorded")
    return ", ".join(parts)


def _unrecorded(load: Load) -> Load:
    return replace(load, cuda_graph=False) if load.cuda_graph is None else load


def _smaller(load: Load, *, pixels: bool) -> Load:
    """One step down, of the image side or of all counts of surfels; of the other at the least."""
    params = load.params
    side = max(LEAST_SIDE, int(params.max_side * SMALLER_SIDE))
    counts = {name: _fewer(getattr(params, name)) for name in CAPS}
    shrinks, thins = side < params.max_side, counts["max_surfels"] < params.max_surfels
    if shrinks and (pixels or not thins):
        return replace(load, params=params.model_copy(update={"max_side": side}))
    return replace(load, params=params.model_copy(update=counts)) if thins else load


def _fewer(count: int) -> int:
    return min(count, max(LEAST_SURFELS, int(count * FEWER_SURFELS)))
