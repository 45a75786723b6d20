"""What a run needs of a GPU's memory, and smaller settings where there is less."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.errors import DeviceError
from refdgs_pipe.training.figures import Progress
from refdgs_pipe.training.photos import most_pixels
from refdgs_pipe.training.settings import StartParams, TrainParams
from refdgs_pipe.training.trainer import Trainer

T = TypeVar("T")

# Bytes, counted from the tensors that live at once in a step: torch and its kernels; maps, shading
# and their gradients for a pixel; parameters, Adam, records and room for entries of 85 to 130 for a
# surfel (at 800 x 800 and 100,000 + 30,000 surfels: 16 entries each, local ones 46, and room for
# half as many again); a number of the Sph-Mip map with Adam, mips and its gradient in whole
# numbers. Recorded steps have pixels' and surfels' memory of their own.
FIXED, PER_PIXEL, PER_SURFEL, PER_MAP_NUMBER = 700_000_000, 800, 5000, 32
SPARE = 0.9  # share of the free memory that is planned with; the rest is lost between blocks
LEAST_SIDE, LEAST_SURFELS = 256, 5000
SMALLER_SIDE, FEWER_SURFELS = 0.85, 0.75
TRIES = 6


@dataclass(frozen=True)
class Load:
    """What a GPU is asked to do.

    Args:
        cuda_graph: whether recorded steps are repeated; None: where they prove equal.
        growth: geometry surfels for each that there may be before they start anew, a factor.
    """

    params: TrainParams
    start: Start
    cuda_graph: bool | None = None
    growth: float = 1.0

    @property
    def most(self) -> int:
        """Geometry surfels at most, those that start anew among them."""
        return round(max(self.start.surfels, self.params.max_surfels) * max(1.0, self.growth))


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
    params, start = load.params, load.start
    cameras = [camera for camera in model.cameras if camera.split == "train"]
    sizes = [most_pixels(camera, model.ball, start.max_side) for camera in cameras]
    kept = sum(sizes) * 5 * (1 + params.coarse**2)  # RGB, mask and validity, at two scales
    surfels = load.most + start.background_surfels
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


def train_part(
    make: Callable[[Load], Trainer],
    load: Load,
    model: SparseModel,
    device: str,
    vram: int,
    progress: Progress,
    warn: Callable[[str], None],
) -> Checkpoint:
    """Run a part of a training on "cpu" or on "cuda", there within its memory and `vram` bytes.

    Raises:
        DeviceError: the GPU's memory is too small.
        TrainingError: the loss stopped being finite.
    """
    if device == "cuda":
        load = planned(load, model, vram=vram, warn=warn)
    trainer, field = train_within(make, load, progress, warn)
    return trainer.checkpoint(field)


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
    raise DeviceError(
        f"the GPU's memory runs out even at {load.start.max_side} pixels and "
        f"{load.params.max_surfels} surfels: free the GPU, or use --device cpu"
    )


def start_within(
    make: Callable[[StartParams], T], params: StartParams, warn: Callable[[str], None]
) -> T:
    """Look for a start; where the GPU's memory runs out, look at smaller pictures.

    Raises:
        DeviceError: it runs out with the smallest ones too.
    """
    for _ in range(TRIES):
        try:
            return make(params)
        except torch.cuda.OutOfMemoryError:
            scale = params.look_scale * SMALLER_SIDE
        torch.cuda.empty_cache()
        fewer = {"look_scale": scale, "look_surfels": _fewer(params.look_surfels)}
        params = params.model_copy(update=fewer)
        warn(f"the GPU's memory ran out: the first look is at {scale:.2f} of the photos' size")
    raise DeviceError("the GPU's memory runs out: free the GPU, or use --device cpu")


def changes(before: Load, after: Load) -> str:
    """What differs, in words."""
    parts = []
    if after.start.max_side != before.start.max_side:
        sides = f"{after.start.max_side} instead of {before.start.max_side} pixels"
        parts.append(f"training at {sides}")
    if after.params.max_surfels != before.params.max_surfels:
        counts = f"{after.params.max_surfels} instead of {before.params.max_surfels} surfels"
        parts.append(f"at most {counts}")
    if after.cuda_graph != before.cuda_graph:
        parts.append("steps are not recorded")
    return ", ".join(parts)


def _unrecorded(load: Load) -> Load:
    return replace(load, cuda_graph=False) if load.cuda_graph is None else load


def _smaller(load: Load, *, pixels: bool) -> Load:
    """One step down, of the image side or of all counts of surfels; of the other at the least."""
    params, start = load.params, load.start
    side = max(LEAST_SIDE, int(start.max_side * SMALLER_SIDE))
    most = _fewer(params.max_surfels)
    shrinks, thins = side < start.max_side, most < params.max_surfels
    if shrinks and (pixels or not thins):
        return replace(load, start=replace(start, max_side=side))
    if not thins:
        return load
    local = _fewer(params.max_local_surfels)
    caps = {"max_surfels": most, "max_local_surfels": local}
    start = start.limited(
        surfels=_fewer(start.surfels),
        local=min(local, _fewer(len(start.local["means"]))),
        background=_fewer(start.background_surfels),
    )
    return replace(load, params=params.model_copy(update=caps), start=start)


def _fewer(count: int) -> int:
    return min(count, max(LEAST_SURFELS, int(count * FEWER_SURFELS)))
