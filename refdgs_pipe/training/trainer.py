"""The optimisation of a Ref-DGS field, resumable at any step."""

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from refdgs_pipe.artifacts.checkpoint import Checkpoint
from refdgs_pipe.artifacts.lighting import WORLD, Lighting
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.start import Start
from refdgs_pipe.artifacts.surfel_field import SurfelField
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.errors import Cancelled, MeshError, TrainingError
from refdgs_pipe.ops import Plan, Readback
from refdgs_pipe.ops.cuda_graph import Recorder
from refdgs_pipe.ops.native import keep_freed_memory
from refdgs_pipe.ops.plan import Asked
from refdgs_pipe.training.checkpoint import read_checkpoint, write_checkpoint
from refdgs_pipe.training.coverage import coverage
from refdgs_pipe.training.field import TrainableField
from refdgs_pipe.training.figures import Figures, Progress
from refdgs_pipe.training.look import covered, limited
from refdgs_pipe.training.photos import TrainingPhoto, load_training_photos, numbered, shrunk
from refdgs_pipe.training.plateau import Plateau, hold_out
from refdgs_pipe.training.recorded import RecordedSteps
from refdgs_pipe.training.renewal import Renewal, renewed
from refdgs_pipe.training.settings import TrainParams
from refdgs_pipe.training.step import Taken, near_of
from refdgs_pipe.training.surfels import array
from refdgs_pipe.training.work import share_behind


@dataclass(frozen=True)
class Moment:
    """What makes a step what it is, so that it can be done again."""

    iteration: int
    fraction: float  # of the schedule
    photo: TrainingPhoto
    backdrop: Tensor  # (3,) sRGB, on the CPU


CHECKPOINT_SECONDS = 30.0
REPORT_STEPS = 10
COVERAGE_VIEWS = 6
LEAST_KEPT = 0.85  # of what the field shows, by discs on its mesh: new ones leave gaps of 7 %


class Trainer:
    """Owns the field, the photos and the random numbers of one part of a run.

    The first part ends where surfels start anew, or with the run. The second one goes on from a
    checkpoint of the first.

    Args:
        start: where the run began.
        after: what the first part ended with; None: this is the first part.
        lighting: how the light moves.
        renewal: what surfels start anew on, and how, when the second part begins.
        device: where the steps are computed, "cpu" or "cuda"; results are on the CPU.
        cuda_graph: whether recorded steps are repeated on a GPU: always (or an error), never, or
            (None) where they prove equal.
        photos: those of the views, if they are in memory already.
        warn: told what does not go as it should and does not end the run.

    Raises:
        TrainingError: no view is left to train on.
    """

    def __init__(
        self,
        views: Views,
        model: SparseModel,
        start: Start,
        params: TrainParams,
        scratch: Path,
        *,
        lighting: Lighting = WORLD,
        after: Checkpoint | None = None,
        renewal: Renewal | None = None,
        device: str = "cpu",
        cuda_graph: bool | None = None,
        photos: list[TrainingPhoto] | None = None,
        warn: Callable[[str], None] | None = None,
    ) -> None:
        keep_freed_memory()
        model = replace(model, ball=start.ball)
        self.params, self.model, self.start = params, model, start
        self.scratch, self.device = scratch, device
        near = near_of(model)
        if photos is None:
            framed = views.background != "photo"
            photos = load_training_photos(
                views, model, max_side=start.max_side, near=near, framed=framed
            )
        self.rng = torch.Generator().manual_seed(start.seed)
        self.masked = views.background != "photo"
        seen = covered(photos, start.covers)
        photos = limited(seen) if start.covers else photos
        refined = params.poses == "refined" and not views.has_known_poses
        self.field = TrainableField(
            params,
            model,
            start,
            seen,
            masked=self.masked,
            near=near,
            device=device,
            refined=refined,
            lighting=lighting,
        )
        if self.field.exposures is not None:
            photos = numbered(photos)
        if params.patience > 0:
            photos = hold_out(photos, start.seed)
        self.full = [photo.to(device) for photo in photos]
        self.plateau = Plateau(params, photos, self.field.reflect_from)
        self.skipped = 0  # steps of the schedule that were left out
        self.scales: dict[float, list[TrainingPhoto]] = {1.0: self.full}
        self.after, self.renewal, self.warn = after, renewal, warn
        self.refused, self.calm = "", False
        self.iteration, self.loss, self.psnr = 0, math.nan, math.nan
        self.plan = None if device == "cpu" else Plan(device)
        recorder, insists = self._recorder(cuda_graph), cuda_graph is True
        self.steps = RecordedSteps(self.field, recorder, insists=insists, warn=warn)
        self._later: Readback[tuple[Moment, Asked]] = Readback(device)  # loss, errors, needs

    def _recorder(self, wanted: bool | None) -> Recorder | None:
        """What records a GPU's steps, where they can be and may be."""
        refines = self.field.poses is not None
        if wanted and refines:
            raise TrainingError(
                "steps that refine poses cannot be recorded: run without --cuda-graph, or set "
                "train.poses to fixed"
            )
        may = wanted is not False and not refines
        return Recorder() if self.device == "cuda" and may else None

    @property
    def end(self) -> int:
        """The step of the schedule that this part ends before."""
        p = self.params
        whole = self.after is not None or p.renew_at >= 1
        return p.iterations if whole else min(p.iterations, math.ceil(p.renew_at * p.iterations))

    def run(self, progress: Progress) -> SurfelField:
        """Train to the end, or until `progress` raises; a checkpoint is kept either way.

        Raises:
            TrainingError: the loss stopped being finite.
            Cancelled: `progress` raised it; the next run continues from here.
        """
        self._resume()
        saved = time.monotonic()
        try:
            while self.position < self.end:
                self.step()
                is_through = self.position == self.params.iterations
                told = self.iteration % REPORT_STEPS == 0 or is_through
                if told and self.params.patience > 0:
                    self._skip_a_plateau()
                if told or self.position >= self.end:
                    figures = Figures(self.loss, self.psnr, len(self.field.geometry))
                    progress(self.iteration, self.end - self.skipped, figures, self._behind())
                if time.monotonic() - saved > CHECKPOINT_SECONDS:
                    self.save()
                    saved = time.monotonic()
        except Cancelled:
            self.save()
            raise
        self._read(all_of_them=True)
        if self.after is None and self.end == self.params.iterations and self.params.renew_at < 1:
            self.refused = "the run ended before (train.renew_at)"
        if self.refused and self.warn is not None:
            self.warn(f"surfels did not start anew, and normals are as they were: {self.refused}")
        return self.frozen()

    def frozen(self) -> SurfelField:
        """The field as it is, and its ball."""
        return replace(self.field.freeze(), ball=self.model.ball)

    @property
    def position(self) -> int:
        """The step of the schedule, of `iterations`: those that were taken or left out."""
        return self.iteration + self.skipped

    def _skip_a_plateau(self) -> None:
        """Once held-out pixels get no better, go on where rates begin to shrink."""
        p = self.params
        tail = math.ceil(p.anneal_from * p.iterations)
        self._read(all_of_them=True)  # or it would depend on when figures arrive
        if self.position < tail and self.plateau.reached(self.position / p.iterations):
            self.skipped = tail - self.position

    @property
    def early(self) -> str | None:
        """Why the run is shorter than asked for, if it is."""
        if not self.skipped:
            return None
        p, plateau = self.params, self.plateau
        return (
            f"{self.skipped} of {p.iterations} steps left out: held-out pixels, {plateau.best:.2f} "
            f"dB at step {round(plateau.best_at * p.iterations)}, gained less than "
            f"{p.patience_tolerance:g} dB in {p.patience:.0%} of the run"
        )

    def figures(self) -> dict[str, Any]:
        """What a checkpoint keeps besides tensors."""
        return {
            "iteration": self.iteration,
            "loss": self.loss,
            "psnr": self.psnr,
            "skipped": self.skipped,
            "early": self.early,
            "plateau": self.plateau.state(),
        }

    def checkpoint(self, field: SurfelField) -> Checkpoint:
        """What the second part goes on from, after a run that ended in this field."""
        is_last = self.position >= self.params.iterations
        tensors = {} if is_last else {k: array(v) for k, v in self._state().items()}
        settings = self.params.model_dump(mode="json")
        return Checkpoint(
            field, tensors, self.figures(), settings, self.start.max_side, self.coverage(field)
        )

    def coverage(self, field: SurfelField) -> float:
        """How much of the object the field shows, over a few training photos; see `coverage`."""
        photos = self.full[:: max(1, len(self.full) // COVERAGE_VIEWS)]
        masks = [
            np.asarray(photo.mask.cpu().numpy() / 255, np.float32)
            for photo in photos
            if photo.mask is not None
        ]
        known = masks if self.masked and len(masks) == len(photos) else None
        cameras = [photo.camera for photo in photos]
        return coverage(field, cameras, known, self.model.ball, device=self.device)

    def step(self) -> None:
        """One photo, one gradient, one update."""
        fraction = self.position / self.params.iterations
        photo = self._photo(fraction)
        backdrop = torch.rand(3, generator=self.rng) if self.masked else torch.zeros(3)
        self._update(Moment(self.iteration, fraction, photo, backdrop))
        self.iteration += 1
        adapts = self.field.adapts(self.position)
        self._read(all_of_them=adapts)
        if adapts:
            self.field.adapt(self.position, self.rng)
            if self.plan is not None:
                self.plan.settle()

    def _renew(self, renewal: Renewal) -> None:
        """Let the object's surfels start anew on the mesh of the field as it is."""
        field, group = self.frozen(), self.field.geometry
        rng = np.random.default_rng(self.start.seed)
        most = max(len(group), renewal.most)
        count = min(round(renewal.surfels * len(group)), most)
        try:
            if renewal.mesh is None:
                raise MeshError(renewal.why_not)
            fresh = renewed(group, renewal.mesh, count, rng)
            before = self.coverage(field)
            shown = self.coverage(replace(field, geometry=fresh.frozen(group))) / max(before, 1e-6)
            if shown < LEAST_KEPT:
                raise MeshError(f"their mesh shows only {shown:.0%} of what they show")
        except MeshError as error:
            self.refused = str(error)
        else:
            fresh.replace(group)
            self._calm()
            if self.plan is not None:
                self.plan.settle()

    def _calm(self) -> None:
        """From now on surfels of all sets turn slowly."""
        if self.renewal is not None and not self.calm:
            self.calm = True
            self.field.rates["quats"] *= self.renewal.turning

    def _update(self, moment: Moment) -> None:
        self.field.set_rates(moment.fraction)
        taken, asked = self.steps.take(moment.photo, moment.backdrop, moment.fraction, self.plan)
        held = self._held_error(moment.photo, taken)
        figures = torch.stack([taken.loss, taken.error, held])
        needed = [] if self.plan is None else [self.plan.needed]
        self._later.send((moment, asked), figures, *needed)

    def _photo(self, fraction: float) -> TrainingPhoto:
        """A random photo at the scale of this moment."""
        p = self.params
        scale = p.coarse if fraction < p.coarse_until else 1.0
        if scale not in self.scales:
            self.scales[scale] = [shrunk(photo, scale) for photo in self.full]
        pick = int(torch.randint(len(self.full), (1,), generator=self.rng))
        return self.scales[scale][pick]

    @staticmethod
    def _held_error(photo: TrainingPhoto, taken: Taken) -> Tensor:
        """The mean squared error of held-out pixels, NaN where there are none."""
        if photo.held is None:
            return taken.loss.new_full((), math.nan)
        rows, columns = photo.held
        return (taken.image[rows, columns] - taken.target[rows, columns]).square().mean()

    def _read(self, *, all_of_them: bool = False) -> None:
        """Take in the figures of steps that are through, some steps later on a GPU.

        A step whose lists had no room has changed nothing, and is done again with more.
        """
        while arrived := self._later.arrived(all_of_them=all_of_them):
            again = []
            for (moment, asked), (figures, *needed) in arrived:
                if self.plan is None or self.plan.learn(asked, *needed):
                    self._note(moment, *figures.tolist())
                else:
                    again.append(moment)
            for moment in again:
                self._update(moment)

    def _note(self, moment: Moment, value: float, error: float, held: float) -> None:
        """Running figures; a loss that is not finite ends the run at the last good checkpoint."""
        step = moment.iteration
        if not math.isfinite(value):
            raise TrainingError(
                f"training diverged at step {step + 1}: the loss is {value}. The last good "
                "checkpoint is kept; lower train.rate_means or change start.seed and run again"
            )
        psnr = -10 * math.log10(max(error, 1e-10))
        keep = 0.98 if math.isfinite(self.loss) else 0.0
        self.loss = value if not keep else keep * self.loss + (1 - keep) * value
        self.psnr = psnr if not keep else keep * self.psnr + (1 - keep) * psnr
        if math.isfinite(held):
            self.plateau.note(moment.photo.camera.name, held, moment.fraction)

    def _behind(self) -> float:
        """The share of this part's work that is done."""
        steps, skipped = self.params.iterations, self.skipped

        def whole(position: float) -> float:
            reflect, left_out = self.field.reflect_from, skipped / steps
            return share_behind(self.params, reflect, position / steps, left_out)

        begin = 0.0
        if self.after is not None:
            figures = self.after.figures
            begin = whole(figures["iteration"] + figures["skipped"])
        end = whole(self.end)
        return (whole(self.position) - begin) / max(end - begin, 1e-9)

    def _state(self) -> dict[str, Tensor]:
        self._read(all_of_them=True)
        return {**self.field.state(), "rng": self.rng.get_state()}

    def save(self) -> None:
        """Write the checkpoint; an older one is replaced only when the new one is complete."""
        tensors = self._state()
        figures = self.figures() | {"refused": self.refused, "calm": self.calm}
        write_checkpoint(self.scratch, tensors, json.dumps(figures))

    def _resume(self) -> None:
        """Go on from where this part was stopped, or from what the first part ended with."""
        found = read_checkpoint(self.scratch)
        if found is not None:
            tensors, text = found
            self._restore(tensors, json.loads(text))
        elif self.after is not None:
            given = {k: torch.from_numpy(np.array(v)) for k, v in self.after.tensors.items()}
            self._restore(given, self.after.figures)
            if self.renewal is not None:
                self._renew(self.renewal)

    def _restore(self, tensors: dict[str, Tensor], figures: Mapping[str, Any]) -> None:
        self.rng.set_state(tensors.pop("rng"))
        self.field.restore(tensors)
        self.iteration, self.loss, self.psnr = (figures[k] for k in ("iteration", "loss", "psnr"))
        self.skipped = figures["skipped"]
        self.refused = figures.get("refused", "")
        if figures.get("calm"):
            self._calm()
        self.plateau.restore(figures["plateau"])
