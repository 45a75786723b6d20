"""About how long a run takes, and how much room it needs. A rough model, and said to be one.

Core-seconds, from the runs in docs/training.md, "Whole runs" and "Photos without masks", and from
docs/performance.md, "Whole steps". They were measured on cores with AVX-512; others take longer.
"""

from dataclasses import dataclass
from typing import Any, Protocol

from refdgs_pipe.checking.look import Look

STEP_S, STEP_MPX_S = 0.1, 0.5  # of a step of training: whatever its size, and for each megapixel
SURFELS = 60_000  # that this is for; a step's time goes with their number
PLAIN = 0.6  # of it without reflections
READ_MPX_S = 0.02  # to read a megapixel of a photo
FEATURE_MPX_S, PAIR_S, PLACE_S = 1.0, 0.05, 0.5  # for a megapixel, a pair, a photo
EXHAUSTIVE_UP_TO, PARTNERS = 150, 15  # photos; each photo's partners above
SURFACE_S, TEXEL_S = 120.0, 15e-6  # mesh and materials; a texel of the textures
SHARED = 0.93  # of a core's work that each further core adds
PNG_BYTES, FIXED_BYTES = 2.0, 150e6  # of a pixel; surfels, meshes, textures and files


class Settings(Protocol):
    """A recipe's settings: stage -> its parameters."""

    def __getitem__(self, stage: str, /) -> Any: ...


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


def cost(look: Look, recipe: str, about: str, settings: Settings, *, cores: int) -> Cost:
    """What a recipe takes for the photos of a look."""
    assert look.views is not None
    count = len(look.views.items)
    shape = _shape(look)
    work = count * (look.megapixels or 1.0) * READ_MPX_S
    if not look.is_known:
        work += _placing(count, _pixels(shape, settings["sfm"].max_side, look.megapixels))
    start, train, bake = (settings[name] for name in ("start", "train", "bake"))
    pixels = _pixels(shape, min(start.max_side, settings["ingest"].max_side), look.megapixels)
    step = STEP_S + STEP_MPX_S * pixels
    step *= max(train.max_surfels / SURFELS, 0.25) * (1.0 if train.reflection else PLAIN)
    work += train.iterations * step
    work += SURFACE_S + bake.size**2 * TEXEL_S
    kept = _pixels(shape, settings["ingest"].max_side, look.megapixels)
    placing = settings["ingest"].placing_side
    if not look.is_known and placing > settings["ingest"].max_side:
        kept += _pixels(shape, placing, look.megapixels)
    room = round(count * kept * 1e6 * PNG_BYTES + FIXED_BYTES)
    return Cost(recipe, about, work, work / (1 + SHARED * (max(cores, 1) - 1)), round(room, -6))


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
