"""About how long a run takes, and how much room it needs. A rough model, and said to be one.

Core-seconds, from the runs in docs/training.md, "Whole runs" and "Photos without masks", and in
docs/experiments/time-estimates.md. They were measured on cores with AVX-512; others take longer.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

from refdgs_pipe.checking.look import Look
from refdgs_pipe.texture.settings import PAINTED_SIDE

STEP_S, STEP_MPX_S = 0.02, 0.5  # of a step of training: whatever its size, and for each megapixel
SURFELS = 60_000  # that this is for; a step's time goes with their number
PLAIN = 0.6  # of it without reflections
READ_MPX_S = 0.02  # to read a megapixel of a photo
FEATURE_MPX_S, PAIR_S, PLACE_S = 1.0, 0.05, 0.5  # for a megapixel, a pair, a photo
EXHAUSTIVE_UP_TO, PARTNERS = 150, 15  # photos; each photo's partners above
SURFACE_S, TEXEL_S = 145.0, 15e-6  # mesh and materials; a texel of the textures
LOOK_S = 0.3  # to compare the shape with a photo
DETAIL_MPX_S, DETAIL_TEXEL_S = 1.2, 4e-7  # fine detail: a megapixel, and a texel, for each photo
GATE_S, MASK_S = 8.0, 4.0  # to check the cameras; to find the object in a photo
START_S, VOLUME_S = 30.0, 0.1  # to find a first shape, without masks; a step of the volume
TRIAL_S = 0.035  # of a step of the trial of near-field features
_SURFACE_SHARES = {
    "extract": 0.05,
    "clean": 0.02,
    "fit": 0.05,
    "appearance": 0.44,
    "unwrap": 0.21,
    "bake": 0.10,
    "export": 0.025,
    "evaluate": 0.105,
}
_FIRST_MESH = ("extract", "clean", "fit")  # what the stage `shape` does as well
_TRAINED = ("start", "train", "shape", "refine")  # stages of training, as far as there are any
SHARED = 0.93  # of a core's work that each further core adds
PNG_BYTES, FIXED_BYTES = 2.0, 150e6  # of a pixel; surfels, meshes, textures and files


Settings: TypeAlias = Mapping[str, Any]  # stage -> its parameters


@dataclass(frozen=True)
class Cost:
    """What one recipe takes.

    Args:
        core_seconds: work; seconds: on so many cores; bytes: of the workspace.
    """

    recipe: str
    about: str
    core_seconds: float
    seconds: float
    bytes: int


@dataclass(frozen=True)
class Capture:
    """What a run's time goes with.

    Args:
        photos: how many; megapixels: of each, None: not known; shape: short side by long side.
        is_known: their places came with them; has_masks: their masks did.
    """

    photos: int
    megapixels: float | None
    shape: float
    is_known: bool
    has_masks: bool


def cost(look: Look, recipe: str, about: str, settings: Settings, *, cores: int) -> Cost:
    """What a recipe takes for the photos of a look."""
    assert look.views is not None
    masked = look.views.background != "photo"
    size = Capture(
        len(look.views.items), look.megapixels, _shape(look), look.is_known, has_masks=masked
    )
    work = sum(works(size, settings).values())
    return Cost(recipe, about, work, seconds_of(work, cores), room(size, settings))


def seconds_of(core_seconds: float, cores: int) -> float:
    """How long work takes on so many cores."""
    return core_seconds / (1 + SHARED * (max(cores, 1) - 1))


def room(size: Capture, settings: Settings) -> int:
    """Bytes of the workspace."""
    ingest = settings["ingest"]
    kept = _pixels(size.shape, ingest.max_side, size.megapixels)
    if not size.is_known and ingest.placing_side > ingest.max_side:
        kept += _pixels(size.shape, ingest.placing_side, size.megapixels)
    return round(round(size.photos * kept * 1e6 * PNG_BYTES + FIXED_BYTES), -6)


def works(size: Capture, settings: Settings) -> dict[str, float]:
    """Stage -> core-seconds. A stage that is not named takes next to none."""
    count = size.photos
    work = {"ingest": 1.0 + count * (size.megapixels or 1.0) * READ_MPX_S}
    if not size.is_known:
        pixels = _pixels(size.shape, settings["sfm"].max_side, size.megapixels)
        work["sfm"] = _placing(count, pixels)
    work["gate"] = 1.0 if size.is_known else GATE_S
    if not size.has_masks:
        work["masks"] = count * MASK_S
    work |= _training(size, settings)
    surface = {stage: SURFACE_S * share for stage, share in _SURFACE_SHARES.items()}
    if work.get("refine"):  # training goes on from a first mesh
        work["shape"] = sum(surface[stage] for stage in _FIRST_MESH)
    if not settings["train"].reflection:  # all that the surface shows is its own colour
        del surface["appearance"]
    work |= surface
    work["bake"] += _baking(size, settings)
    return work


def _baking(size: Capture, settings: Settings) -> float:
    """Core-seconds of the textures."""
    side = settings["bake"].size
    looked = size.photos * LOOK_S
    if not settings["bake"].detail:
        return float(side**2 * TEXEL_S + looked)
    read = _pixels(size.shape, settings["ingest"].max_side, size.megapixels)
    each = read * DETAIL_MPX_S + side**2 * DETAIL_TEXEL_S
    return float(min(side, PAINTED_SIDE) ** 2 * TEXEL_S + looked + size.photos * each)


def _training(size: Capture, settings: Settings) -> dict[str, float]:
    """Core-seconds of the stages of training, whether it is one stage or several."""

    def of(name: str) -> Any:
        groups = (settings[stage] for stage in _TRAINED if stage in settings)
        return next(getattr(group, name) for group in groups if hasattr(group, name))

    side = min(of("max_side"), settings["ingest"].max_side)
    step = STEP_S + STEP_MPX_S * _pixels(size.shape, side, size.megapixels)
    step *= max(of("max_surfels") / SURFELS, 0.25) * (1.0 if of("reflection") else PLAIN)
    start = of("volume_steps") * VOLUME_S + (0.0 if size.has_masks else START_S)
    whole, trial = of("iterations") * step, 0.0
    if of("reflection") and of("local") == "dual" and of("local_trial_steps") <= of("iterations"):
        trial = 2 * of("local_trial_steps") * TRIAL_S
    if "refine" not in settings:
        return {"train": start + trial + whole}
    before = min(of("renew_at"), 1.0)
    return {"start": start, "train": trial + whole * before, "refine": whole * (1.0 - before)}


def _placing(count: int, pixels: float) -> float:
    """Core-seconds of structure from motion."""
    pairs = count * (count - 1) / 2 if count <= EXHAUSTIVE_UP_TO else count * PARTNERS
    return count * (pixels * FEATURE_MPX_S + PLACE_S) + pairs * PAIR_S


def _shape(look: Look) -> float:
    """Short side by long side, of the first photo."""
    assert look.views is not None
    view = look.views.items[0]
    return min(view.width, view.height) / max(view.width, view.height)


def _pixels(shape: float, side: int, megapixels: float | None) -> float:
    """Megapixels of a photo that is reduced to a long side."""
    reduced = side * side * shape / 1e6
    return reduced if megapixels is None else min(reduced, megapixels)
