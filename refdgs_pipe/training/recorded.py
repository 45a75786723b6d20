"""Steps that a GPU does again without the CPU: recorded once, proved, replayed.

Between densifications the same kernels run on the same memory in every step. What differs (the
photo, its camera, the backdrop, the rates) lies in buffers on the GPU; Adam counts its steps there.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from refdgs_pipe.errors import TrainingError
from refdgs_pipe.ops import Plan, addresses, rates_of
from refdgs_pipe.ops.cuda import sent
from refdgs_pipe.ops.plan import Asked
from refdgs_pipe.training.field import TrainableField
from refdgs_pipe.training.photos import TENSORS, TrainingPhoto
from refdgs_pipe.training.step import Taken, take_step

WAITS = 3  # steps of a kind before one is recorded: many sizes of photos are not worth it
MOST = 4  # kinds that are recorded between two densifications
TOLERANCE = 1e-3  # of what a replayed step may change otherwise than the same step without
LENS = 19  # numbers of `Pinhole.numbers`


class Replayable(Protocol):
    """Recorded work."""

    made: Taken

    def replay(self) -> None:
        """Do it again."""


class Recorder(Protocol):
    """What records work: `ops.cuda_graph.Recorder`, or a test's."""

    def record(self, work: Callable[[], Taken], /) -> Replayable:
        """Without doing it."""


class Buffers:
    """Where a recorded step reads what differs from step to step.

    Args:
        like: gives sizes, and what else the step knows of its photo.
    """

    def __init__(self, like: TrainingPhoto, rates: int) -> None:
        numbers = torch.zeros(LENS + 3 + rates, device=like.rgb.device)
        self._numbers = numbers
        lens, self.backdrop, self.rates = torch.split(numbers, [LENS, 3, rates])
        lensed = replace(like, pinhole=replace(like.pinhole, lens=lens), held=None)
        self.photo = lensed.each(Tensor.clone)

    def load(self, photo: TrainingPhoto, backdrop: Tensor, rates: list[float]) -> None:
        """Fill in a step's own; nothing waits.

        Args:
            backdrop: (3,) on the CPU.
        """
        numbers = torch.tensor([*photo.pinhole.numbers(), *backdrop.tolist(), *rates])
        device = self._numbers.device.type
        self._numbers.copy_(sent(numbers, device), non_blocking=True)
        for name in TENSORS:
            to, given = getattr(self.photo, name), getattr(photo, name)
            if to is not None and given is not None:
                to.copy_(given, non_blocking=True)


@dataclass(frozen=True)
class _Recording:
    work: Replayable
    buffers: Buffers
    asked: Asked


class RecordedSteps:
    """Takes steps, and has those of a kind recorded once the kind is known to come again.

    Every recording proves itself: a step is taken as usual, undone, and done by the recording,
    which was made with another photo and other rates. Where that changes anything otherwise, or
    fails, the usual step counts, and so does every one after it.

    Args:
        recorder: null: steps are never recorded.
        insists: an error instead of going on as usual.
        warn: told once why it goes on as usual.
    """

    def __init__(
        self,
        field: TrainableField,
        recorder: Recorder | None,
        *,
        insists: bool = False,
        warn: Callable[[str], None] | None = None,
    ) -> None:
        self._field, self._recorder, self._insists = field, recorder, insists
        self._warn = warn
        self._recordings: dict[object, _Recording] = {}
        self._seen: Counter[object] = Counter()
        self._before: dict[object, TrainingPhoto] = {}
        self._places: list[tuple[int, int]] = []
        self.replayed = 0  # steps

    def take(
        self, photo: TrainingPhoto, backdrop: Tensor, fraction: float, plan: Plan | None
    ) -> tuple[Taken, Asked]:
        """One step with the field's rates of now, and the lists that it asked room for.

        What is returned is good until the next step.

        Args:
            backdrop: (3,) on the CPU.
        """
        if self._recorder is None or plan is None:
            return self._as_usual(photo, backdrop, fraction, plan)
        places = [(addresses.of(tensor), tensor.numel()) for tensor in _tensors(self._field)]
        if places != self._places:
            self.forget()
            self._places = places
        kind = self._kind(photo, fraction)
        found = self._recordings.get(kind)
        if found is not None and not plan.holds(found.asked):
            _finish()  # the GPU may be at it
            del self._recordings[kind]
            found = None
        if found is not None:
            found.buffers.load(photo, backdrop, rates_of(self._field.optimizers()))
            found.work.replay()
            self.replayed += 1
            return found.work.made, found.asked
        self._seen[kind] += 1
        before = self._before.get(kind, photo)
        self._before[kind] = photo
        if self._seen[kind] <= WAITS or len(self._recordings) >= MOST:
            return self._as_usual(photo, backdrop, fraction, plan)
        return self._recorded(kind, before, photo, backdrop, fraction, plan)

    def forget(self) -> None:
        """The field's memory has moved, or something else that recordings rely on is another."""
        if self._recordings:
            _finish()
        self._recordings.clear()
        self._seen.clear()
        self._before.clear()
        self._places = []

    def _kind(self, photo: TrainingPhoto, fraction: float) -> object:
        """What a recording cannot be told anew."""
        camera = photo.pinhole
        size = (camera.width, camera.height, camera.near, photo.lever)
        told = tuple(getattr(photo, name) is None for name in TENSORS if name != "held")
        field = self._field
        return (*size, *told, *field.parts(fraction), field.weighs_specular(fraction))

    def _as_usual(
        self, photo: TrainingPhoto, backdrop: Tensor, fraction: float, plan: Plan | None
    ) -> tuple[Taken, Asked]:
        there = sent(backdrop, self._field.device)
        taken = take_step(self._field, photo, there, fraction, plan=plan)
        return taken, [] if plan is None else plan.asked()

    def _recorded(
        self,
        kind: object,
        before: TrainingPhoto,
        photo: TrainingPhoto,
        backdrop: Tensor,
        fraction: float,
        plan: Plan,
    ) -> tuple[Taken, Asked]:
        """A step as usual, and the same again by a recording that replaces it if it proves good."""
        assert self._recorder is not None
        field = self._field
        was = _copies(_tensors(field))
        usual = self._as_usual(photo, backdrop, fraction, plan)
        if float(plan.misfit):
            return usual  # and changes nothing, which proves nothing
        wanted = _copies(_tensors(field))
        rates = rates_of(field.optimizers())
        try:
            _restore(_tensors(field), was)
            buffers = Buffers(before, len(rates))

            def work() -> Taken:
                return take_step(
                    field, buffers.photo, buffers.backdrop, fraction, plan=plan, rates=buffers.rates
                )

            with _no_rates(field):
                recorded = self._recorder.record(work)
            recording = _Recording(recorded, buffers, plan.asked())
            buffers.load(photo, backdrop, rates)
            recorded.replay()
            differs = _difference(was, wanted, _tensors(field), usual[0], recorded.made)
            if not differs <= TOLERANCE:
                raise TrainingError(f"a replayed step differs by {differs:.1g} of what it changes")
        except Exception as error:  # whatever it is, training can do without
            for optimizer in field.optimizers():
                optimizer.zero_grad(set_to_none=True)
            _restore(_tensors(field), wanted)
            self._give_up(error)
            return usual
        self._recordings[kind] = recording
        self.replayed += 1
        return recorded.made, recording.asked

    def _give_up(self, error: Exception) -> None:
        self.forget()
        self._recorder = None
        why = f"steps could not be recorded for the GPU: {error}"
        if self._insists:
            raise TrainingError(f"{why}. Run without --cuda-graph") from error
        if self._warn is not None:
            self._warn(f"{why}. Training goes on without, more slowly")


def _finish() -> None:
    """Wait for the GPU, if there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _tensors(field: TrainableField) -> list[Tensor]:
    """All that a step changes."""
    out = field.statistics()
    for optimizer in field.optimizers():
        for group in optimizer.param_groups:
            for values in group["params"]:
                out += [values, *optimizer.state.get(values, {}).values()]
    return out


@contextmanager
def _no_rates(field: TrainableField) -> Iterator[None]:
    """Rates of 0, so that a recording which does not read its own changes nothing, and shows."""
    groups = [group for optimizer in field.optimizers() for group in optimizer.param_groups]
    rates = [group["lr"] for group in groups]
    try:
        for group in groups:
            group["lr"] = 0.0
        yield
    finally:
        for group, rate in zip(groups, rates, strict=True):
            group["lr"] = rate


def _copies(tensors: list[Tensor]) -> list[Tensor]:
    return [tensor.detach().clone() for tensor in tensors]


def _restore(tensors: list[Tensor], values: list[Tensor]) -> None:
    with torch.no_grad():
        for tensor, value in zip(tensors, values, strict=True):
            tensor.copy_(value)


def _difference(
    was: list[Tensor], wanted: list[Tensor], found: list[Tensor], usual: Taken, made: Taken
) -> float:
    """How far a step's changes of any tensor, its figures and its image are from the usual step's.

    As a share of those, by norm; NaN if one is.
    """
    shares = []
    for old, new, other in zip(was, wanted, found, strict=True):
        change, noise = (new - old).norm(), 1e-6 * old.norm() + 1e-30
        shares.append((other.detach() - new).norm() / (change + noise))
    for name, value in vars(usual).items():
        shares.append((getattr(made, name) - value).norm() / (value.norm() + 1e-30))
    values: list[float] = torch.stack(shares).tolist()
    return math.nan if any(math.isnan(v) for v in values) else max(values)
