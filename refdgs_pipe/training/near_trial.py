"""Whether near-field features explain photos that training has not seen.

Local reflection surfels are free to show each photo something else. Where many photos see the same
place, they find what is mirrored there. Where few do, or where shape or masks are not quite right,
they learn each photo by heart: the photos of the training look right, all other views are stained.
Two short trainings, with and without them, are compared by photos that neither of them saw.
"""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from refdgs_pipe.artifacts.lighting import WORLD, Lighting
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.training.field import TrainableField
from refdgs_pipe.training.look import covered, limited
from refdgs_pipe.training.photos import TrainingPhoto, load_training_photos, shrunk
from refdgs_pipe.training.settings import TrainParams
from refdgs_pipe.training.short_run import explained, short_run
from refdgs_pipe.training.step import near_of

EACH = 5  # one photo in so many is held out
FEWEST = 10  # photos; with fewer, none can be spared, and few agree on anything
SIDE = 200  # pixels of the photos, at most
INSIDE = 2  # pixels of the mask's edge that do not count: masks are least certain there
RESULT = "near_trial.json"


@dataclass(frozen=True)
class NearTrial:
    """PSNR in dB of held-out photos on the object, with near-field features and without."""

    near: float
    far: float

    @property
    def helps(self) -> bool:
        """Whether near-field features explain them better."""
        return self.near > self.far

    @property
    def words(self) -> str:
        """Both figures, for people."""
        return f"{self.near:.2f} dB with them, {self.far:.2f} dB without"


def settled(
    params: TrainParams,
    views: Views,
    model: SparseModel,
    start: Start,
    scratch: Path,
    *,
    lighting: Lighting = WORLD,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[TrainParams, NearTrial | None]:
    """The settings, without near-field features if they do not help; and the trial, if any.

    Too few photos for a trial are too few for near-field features.

    Args:
        scratch, lighting, progress: of `near_trial`.

    Raises:
        TrainingError: no view is left to train on.
    """
    if not is_due(params):
        return params, None
    masked, near = views.background != "photo", near_of(replace(model, ball=start.ball))
    photos = load_training_photos(views, model, max_side=start.max_side, near=near, framed=masked)
    found = near_trial(
        params, model, start, photos, scratch, masked=masked, lighting=lighting, progress=progress
    )
    if found is not None and found.helps:
        return params, found
    return params.model_copy(update={"local": "none"}), found


def is_due(params: TrainParams) -> bool:
    """Whether there are near-field features to try, in a training that is worth the trial."""
    own = params.reflection and params.local == "dual"
    return own and 0 < params.local_trial_steps <= params.iterations


def near_trial(
    params: TrainParams,
    model: SparseModel,
    start: Start,
    photos: list[TrainingPhoto],
    scratch: Path,
    *,
    masked: bool,
    lighting: Lighting = WORLD,
    progress: Callable[[int, int], None] | None = None,
) -> NearTrial | None:
    """Explain held-out photos with near-field features and without; None: too few photos.

    It runs on the CPU, so that the answer is the same with and without a GPU. The answer stays in
    `scratch`, for a training that is interrupted and goes on.

    Args:
        photos: on the CPU, as they are loaded; masked: their background is removed.
        progress: told the steps done and their number; may raise.
    """
    if len(photos) < FEWEST:
        return None
    if (before := _known(scratch)) is not None:
        return before
    model = replace(model, ball=start.ball)
    small = [shrunk(photo, min(1.0, SIDE / _longest(photo))) for photo in photos]
    seen = covered(small, start.covers)
    learnt = limited(seen) if start.covers else seen
    held = range(EACH // 2, len(photos), EACH)
    known = [i for i in range(len(photos)) if i not in held]
    figures = {}
    for number, (name, local) in enumerate((("near", "dual"), ("far", "none"))):

        def told(step: int, steps: int, arm: int = number) -> None:
            if progress is not None:
                progress(arm * steps + step, 2 * steps)

        short = params.model_copy(update=_short(params) | {"local": local})
        field = TrainableField(
            short,
            model,
            start,
            [seen[i] for i in known],
            masked=masked,
            near=near_of(model),
            lighting=lighting,
        )
        among = [learnt[i] for i in known]
        steps = params.local_trial_steps
        short_run(field, among, steps, start.seed, masked=masked, progress=told)
        figures[name] = explained(field, [seen[i] for i in held], _inside)
    found = NearTrial(**figures)
    (scratch / RESULT).write_text(json.dumps(asdict(found)), "utf-8")
    return found


def _known(scratch: Path) -> NearTrial | None:
    """The answer of an earlier, interrupted training; None if there is none that can be read."""
    try:
        figures = json.loads((scratch / RESULT).read_text("utf-8"))
        return NearTrial(near=float(figures["near"]), far=float(figures["far"]))
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _longest(photo: TrainingPhoto) -> int:
    return max(photo.camera.width, photo.camera.height)


def _short(params: TrainParams) -> dict[str, Any]:
    """The settings of a short training that differ from those of the long one."""
    return {
        "iterations": params.local_trial_steps,
        "environment_height": min(64, params.environment_height),
        "coarse": 1.0,
        "renew_at": 1.0,
        "patience": 0.0,
        "poses": "fixed",
    }


def _inside(photo: TrainingPhoto) -> NDArray[np.bool_]:
    """(H, W) the object without the edge of its mask, where the photo is valid; all without one."""
    there = np.ones((photo.camera.height, photo.camera.width), np.bool_)
    if photo.mask is not None:
        there = binary_erosion(photo.mask.numpy() > 127, iterations=INSIDE)
    return there if photo.valid is None else there & photo.valid.numpy()
