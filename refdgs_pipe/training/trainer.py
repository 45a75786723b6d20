"""The optimisation of a Ref-DGS field, resumable at any step."""

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from refdgs_pipe.artifacts.mesh import TriangleMesh
from refdgs_pipe.artifacts.sparse_model import SparseModel
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
from refdgs_pipe.training.initial import Cloud
from refdgs_pipe.training.look import Look, look
from refdgs_pipe.training.photos import TrainingPhoto, load_training_photos, numbered, shrunk
from refdgs_pipe.training.plateau import Plateau, hold_out
from refdgs_pipe.training.recorded import RecordedSteps
from refdgs_pipe.training.renewal import TURNING, renewed
from refdgs_pipe.training.settings import TrainParams
from refdgs_pipe.training.step import NEAR, Taken
from refdgs_pipe.training.stereo_start import agreed_cloud
from refdgs_pipe.training.work import share_behind


@dataclass(frozen=True)
class Moment:
    """What makes a step what it is, so that it can be done again."""

    iteration: int
    fraction: float  # of the schedule
    photo: TrainingPhoto
    backdrop: Tensor  # (3,) sRGB, on the CPU


@dataclass(frozen=True)
class Figures:
    """How a run goes: running means of the loss and of the PSNR in dB, and geometry surfels."""

    loss: float
    psnr: float
    surfels: int

    @property
    def words(self) -> str:
        """For people."""
        return f"loss {self.loss:.4f}  PSNR {self.psnr:.2f} dB  {self.surfels} surfels"


Progress = Callable[[int, int, Figures, float], None]  # step, steps, share of the work
CHECKPOINT_SECONDS = 30.0
REPORT_STEPS = 10
COVERAGE_VIEWS = 6
LEAST_KEPT = 0.85  # of what the field shows, by discs on its mesh: new ones leave gaps of 7 %


class Trainer:
    """Owns the field, the photos and the random numbers of one run.

    Args:
        device: where the steps are computed, "cpu" or "cuda"; results are on the CPU.
        cuda_graph: whether recorded steps are repeated on a GPU: always (or an error), never, or
            (None) where they prove equal.
        photos: those of the views, if they are in memory already.
        warn: told what does not go as it should and does not end the run.
        starting: told the steps done and their number while the start is looked for; may raise.
        surface: the mesh of a field, to start anew on; may raise.
    """

    def __init__(
        self,
        views: Views,
        model: SparseModel,
        params: TrainParams,
        scratch: Path,
        *,
        device: str = "cpu",
        cuda_graph: bool | None = None,
        photos: list[TrainingPhoto] | None = None,
        warn: Callable[[str], None] | None = None,
        starting: Callable[[int, int], None] | None = None,
        surface: Callable[[SurfelField], TriangleMesh] | None = None,
    ) -> None:
        keep_freed_memory()
        self.params, self.model, self.scratch, self.device = params, model, scratch, device
        distances = [float(np.linalg.norm(c.center - model.ball.center)) for c in model.cameras]
        self.near = NEAR * min(distances)
        if photos is None:
            photos = load_training_photos(views, model, max_side=params.max_side, near=self.near)
        if not photos:
            raise TrainingError("no photo is left to train on: every view is held out or lost")
        self.rng = torch.Generator().manual_seed(params.seed)
        torch.manual_seed(params.seed)
        self.masked = views.background != "photo"
        agreed, seen = self._start(photos, starting)
        self.stereo = agreed is not None
        photos = seen.limited if seen.background is not None else photos
        self.field = TrainableField(
            params,
            model,
            seen.photos,
            masked=self.masked,
            near=self.near,
            device=device,
            behind=seen.background,
            agreed=agreed,
            refined=params.poses == "refined" and not views.has_known_poses,
            restored=read_checkpoint(scratch) is not None,
            progress=starting,
        )
        if self.field.exposures is not None:
            photos = numbered(photos)
        if params.patience > 0:
            photos = hold_out(photos, params.seed)
        self.full = [photo.to(device) for photo in photos]
        self.plateau = Plateau(params, photos, self.field.reflect_from)
        self.skipped = 0  # steps of the schedule that were left out
        self.scales: dict[float, list[TrainingPhoto]] = {1.0: self.full}
        self.surface, self.warn = surface, warn
        self.renewed = surface is None or params.renew_at >= 1
        self.refused, self.calm = "", False
        self.iteration, self.loss, self.psnr = 0, math.nan, math.nan
        self.curve: list[tuple[int, float, float]] = []
        self.plan = None if device == "cpu" else Plan(device)
        recorder, insists = self._recorder(cuda_graph), cuda_graph is True
        self.steps = RecordedSteps(self.field, recorder, insists=insists, warn=warn)
        self._later: Readback[tuple[Moment, Asked]] = Readback(device)  # loss, errors, needs

    def _start(
        self, photos: list[TrainingPhoto], starting: Callable[[int, int], None] | None
    ) -> tuple[Cloud | None, Look]:
        """What photos without masks agree on, if they start there, or what a look at them found."""
        agreed = None
        if not self.masked:
            agreed = agreed_cloud(self.params, self.model, photos, self.scratch, starting)
        if self.masked or agreed is not None or self.params.look_steps == 0:
            return agreed, Look(photos, None)
        return None, look(
            self.params,
            self.model,
            photos,
            self.scratch,
            near=self.near,
            device=self.device,
            progress=starting,
        )

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

    def run(self, progress: Progress) -> SurfelField:
        """Train to the end, or until `progress` raises; a checkpoint is kept either way.

        Raises:
            TrainingError: the loss stopped being finite.
            Cancelled: `progress` raised it; the next run continues from here.
        """
        self._resume()
        saved = time.monotonic()
        try:
            while self.position < self.params.iterations:
                self.step()
                last = self.position == self.params.iterations
                if self.iteration % REPORT_STEPS == 0 or last:
                    if self.params.patience > 0:
                        self._skip_a_plateau()
                    figures = Figures(self.loss, self.psnr, len(self.field.geometry))
                    total = self.params.iterations - self.skipped
                    progress(self.iteration, total, figures, self._behind())
                if time.monotonic() - saved > CHECKPOINT_SECONDS:
                    self.save()
                    saved = time.monotonic()
        except Cancelled:
            self.save()
            raise
        self._read(all_of_them=True)
        if not self.renewed:
            self.refused = "the run ended before (train.renew_at)"
        if self.refused and self.warn is not None:
            self.warn(f"surfels did not start anew, and normals are as they were: {self.refused}")
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

    def figures(self, field: SurfelField) -> list[tuple[str, float | int | str, str]]:
        """What to tell of a run that is through: name, value, unit."""
        early = [("stopped early", self.early, "")] if self.early else []
        side = [("start", "what neighbouring photos agree on", "")] if self.stereo else []
        return [
            *side,
            ("steps", self.iteration, ""),
            *early,
            ("loss", round(self.loss, 5), ""),
            ("train PSNR", round(self.psnr, 2), "dB"),
            ("surfels", len(field.geometry), ""),
            ("local surfels", len(field.local), ""),
            ("background surfels", len(field.background), ""),
        ]

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
        if not self.renewed and self.position >= self.params.renew_at * self.params.iterations:
            self._renew()
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

    def _renew(self) -> None:
        """Let the object's surfels start anew on the mesh of the field as it is."""
        assert self.surface is not None
        self._read(all_of_them=True)
        field, group, p = self.field.freeze(), self.field.geometry, self.params
        rng, most = np.random.default_rng(p.seed), max(len(group), p.most_surfels)
        count = min(round(p.renew_surfels * len(group)), most)
        try:
            fresh = renewed(group, self.surface(field), count, rng)
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
        self.renewed = True

    def _calm(self) -> None:
        """From now on surfels of all sets turn slowly."""
        if self.calm:
            return
        self.calm = True
        self.field.rates["quats"] *= TURNING

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
                "checkpoint is kept; lower train.rate_means or change train.seed and run again"
            )
        psnr = -10 * math.log10(max(error, 1e-10))
        keep = 0.98 if math.isfinite(self.loss) else 0.0
        self.loss = value if not keep else keep * self.loss + (1 - keep) * value
        self.psnr = psnr if not keep else keep * self.psnr + (1 - keep) * psnr
        if math.isfinite(held):
            self.plateau.note(moment.photo.camera.name, held, moment.fraction)
        if step % 50 == 0:
            self.curve.append((step, self.loss, self.psnr))

    def _behind(self) -> float:
        steps = self.params.iterations
        skipped = self.skipped / steps
        return share_behind(self.params, self.field.reflect_from, self.position / steps, skipped)

    def save(self) -> None:
        """Write the checkpoint; an older one is replaced only when the new one is complete."""
        self._read(all_of_them=True)
        tensors = {**self.field.state(), "rng": self.rng.get_state()}
        figures: dict[str, object] = {
            "iteration": self.iteration,
            "loss": self.loss,
            "psnr": self.psnr,
        }
        figures |= {"skipped": self.skipped, "plateau": self.plateau.state(), "curve": self.curve}
        figures |= {"renewed": self.renewed, "refused": self.refused, "calm": self.calm}
        write_checkpoint(self.scratch, tensors, json.dumps(figures))

    def _resume(self) -> None:
        found = read_checkpoint(self.scratch)
        if found is None:
            return
        tensors, text = found
        figures = json.loads(text)
        self.rng.set_state(tensors.pop("rng"))
        self.field.restore(tensors)
        self.iteration, self.loss, self.psnr = (figures[k] for k in ("iteration", "loss", "psnr"))
        self.skipped = figures.get("skipped", 0)
        self.renewed = figures.get("renewed", self.renewed)
        self.refused = figures.get("refused", "")
        if figures.get("calm"):
            self._calm()
        self.plateau.restore(figures.get("plateau", {}))
        self.curve = [(int(a), float(b), float(c)) for a, b, c in figures["curve"]]
