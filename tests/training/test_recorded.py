"""Steps that a GPU does again: what varies reaches them, they prove themselves, and can fail."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from emulation import emulated
from torch import Tensor
from training.test_trainer import SMALL, capture
from training_runs import trainer_of

from refdgs_pipe.errors import TrainingError
from refdgs_pipe.ops import Plan, Readback, addresses
from refdgs_pipe.ops import plan as planning
from refdgs_pipe.training import recorded, step, surfels
from refdgs_pipe.training.recorded import RecordedSteps
from refdgs_pipe.training.step import Taken
from refdgs_pipe.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("coarse_start")

SHORT = {
    "iterations": 10,
    "surfels": 100,
    "local_surfels": 60,
    "densify_every": 5,
    "masked": "ball",
    "reflect_from": 0.0,
    "local_from": 0.0,
    "specular_from": 0.4,
}


BRIEF = {"iterations": 4, "surfels": 60, "masked": "ball"}  # the third step is recorded


class Tape:
    """Records as a GPU does: nothing is done, then again and again with what Python had then."""

    def __init__(self, trainer: Trainer, tamper: Callable[[Trainer], None] | None = None) -> None:
        self.trainer, self.tamper, self.records, self.replays = trainer, tamper, 0, 0
        self.latest: Tape.Recorded | None = None

    def record(self, work: Callable[[], Taken]) -> "Tape.Recorded":
        self.records += 1
        tensors = recorded._tensors(self.trainer.field)
        before = recorded._copies(tensors)
        made = work()
        recorded._restore(tensors, before)
        assert self.trainer.plan is not None
        rooms = [room for *_, room in self.trainer.plan.asked()]
        self.latest = Tape.Recorded(self, work, made, rooms)
        return self.latest

    class Recorded:
        def __init__(
            self, tape: "Tape", work: Callable[[], Taken], made: Taken, rooms: list[int]
        ) -> None:
            self.tape, self.work, self.rooms = tape, work, rooms
            self.made = Taken(*(torch.zeros_like(value) for value in vars(made).values()))

        def replay(self) -> None:
            self.tape.replays += 1
            rooms = iter(self.rooms)
            with pytest.MonkeyPatch.context() as patch:
                room = Plan.room
                patch.setattr(Plan, "room", lambda *a, **k: room(*a, **k) and next(rooms))
                with recorded._no_rates(self.tape.trainer.field):  # as they were when it recorded
                    made = self.work()
            for name, value in vars(made).items():
                getattr(self.made, name).copy_(value)
            if self.tape.tamper is not None:
                self.tape.tamper(self.tape.trainer)


def trained(
    folder: Path,
    *,
    tape: Callable[[Trainer], Tape] | None = Tape,
    change: Callable[[Trainer], None] | None = None,
    has_masks: bool = True,
    insists: bool = False,
    **settings: Any,
) -> tuple[Trainer, Tape | None, list[str]]:
    """A short training with the emulated kernels and planned lists, and what it warned of."""
    views, model = capture(folder / "views", size=20, masked=has_masks)
    params = SMALL.but(**{**SHORT, **settings})
    trainer, warnings = trainer_of(views, model, params, folder), list[str]()
    trainer.plan, trainer._later = Plan("cpu"), Readback("cpu", lag=2)
    made = None if tape is None else tape(trainer)
    trainer.steps = RecordedSteps(trainer.field, made, insists=insists, warn=warnings.append)
    if change is not None:
        change(trainer)
    with emulated():
        for _ in range(params.train.iterations):
            trainer.step()
        trainer._read(all_of_them=True)
    return trainer, made, warnings


def assert_same(found: Trainer, wanted: Trainer) -> None:
    assert found.loss == wanted.loss and found.psnr == wanted.psnr
    assert len(found.field.geometry) > 0
    for name, value in wanted.field.state().items():
        assert torch.equal(found.field.state()[name], value), name


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorded, "WAITS", 1)


@pytest.mark.parametrize(
    ("settings", "masked"),
    [({"patience": 0.5}, True), (BRIEF | {"iterations": 6}, False)],
)
def test_replayed_steps_are_steps(tmp_path: Path, settings: dict[str, Any], masked: bool) -> None:
    """Every photo, rate and backdrop reaches them; densification has them recorded anew."""
    with_tape, tape, warnings = trained(tmp_path / "a", has_masks=masked, **settings)
    without, *_ = trained(tmp_path / "b", tape=None, has_masks=masked, **settings)
    assert_same(with_tape, without)
    assert not warnings and tape is not None
    assert tape.records == 2 or not masked
    assert (
        tape.replays == with_tape.steps.replayed >= with_tape.params.iterations - 4 * tape.records
    )
    assert tape.replays > 1


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> Trainer:
    """A brief training without recorded steps."""
    return trained(tmp_path_factory.mktemp("usual"), tape=None, **BRIEF)[0]


def _first(trainer: Trainer) -> Tensor:
    return trainer.field.geometry.raw["means"]


def _nudge(trainer: Trainer) -> None:
    with torch.no_grad():
        _first(trainer).add_(1e-4)


def _raise(trainer: Trainer) -> None:
    _nudge(trainer)
    _first(trainer).grad = torch.zeros_like(_first(trainer))
    raise RuntimeError("an illegal thing")


def _break(trainer: Trainer) -> None:
    with torch.no_grad():
        _first(trainer)[0] = torch.nan


def _misdraw(trainer: Trainer) -> None:
    """What it says of its figures is no number."""
    tape = trainer.steps._recorder
    assert isinstance(tape, Tape) and tape.latest is not None
    tape.latest.made.error.fill_(torch.nan)


@pytest.mark.parametrize(
    ("tamper", "says"),
    [
        (_nudge, "differs by"),
        (_break, "differs by nan"),
        (_misdraw, "differs by nan"),
        (_raise, "illegal"),
    ],
)
def test_what_does_not_prove_good_is_left_alone(
    tmp_path: Path, tamper: Callable[[Trainer], None], says: str, usual: Trainer
) -> None:
    found, tape, warnings = trained(tmp_path, tape=lambda t: Tape(t, tamper), **BRIEF)
    assert_same(found, usual)
    assert tape is not None and tape.records == tape.replays == 1
    assert len(warnings) == 1 and says in warnings[0] and "goes on without" in warnings[0]


def test_who_insists_gets_an_error(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"an illegal thing.*without --cuda-graph"):
        trained(tmp_path, tape=lambda t: Tape(t, _raise), insists=True, **BRIEF)


def test_the_proof_sees_a_camera_that_stays(tmp_path: Path, monkeypatch: Any) -> None:
    """The recording is made with another photo than the one that it is proved on."""
    monkeypatch.setattr(addresses, "lens", lambda camera: 0)
    _, _, warnings = trained(tmp_path, **BRIEF)
    assert len(warnings) == 1 and "differs by" in warnings[0]


def test_the_proof_sees_rates_that_stay(tmp_path: Path, monkeypatch: Any) -> None:
    step = surfels.adam_step
    monkeypatch.setattr(surfels, "adam_step", lambda o, misfit, rates: step(o, misfit))
    _, _, warnings = trained(tmp_path, **BRIEF)
    assert len(warnings) == 1 and "differs by" in warnings[0]


def test_lists_that_outgrow_a_recording_have_it_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planning, "LEAST", 1)

    def later_more(trainer: Trainer) -> None:
        """From the fifth step on entries seem to have been more than was thought."""
        step = trainer._read

        def read(*, all_of_them: bool = False) -> None:
            step(all_of_them=all_of_them)
            plan = trainer.plan
            if trainer.iteration == 5 and plan is not None:
                more = {key: 3 * share for key, share in plan._most.items() if share > 1}
                assert more  # entries of a surfel, not pixels of a pixel
                plan._most |= more

        trainer._read = read  # type: ignore[method-assign]

    short = {"iterations": 8, "densify_every": 50, "surfels": 60}
    _, tape, warnings = trained(tmp_path, change=later_more, **short)
    assert tape is not None and tape.records == 2 and not warnings


def test_each_kind_of_photo_has_its_own_and_there_are_not_too_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded, "MOST", 1)

    def some_invalid(trainer: Trainer) -> None:
        for i in range(0, len(trainer.full), 2):
            valid = torch.ones(20, 20, dtype=torch.bool)
            valid[:3] = False
            trainer.full[i] = replace(trainer.full[i], valid=valid)

    short = {"iterations": 10, "densify_every": 50, "surfels": 60}
    few, tape, _ = trained(tmp_path / "a", change=some_invalid, **short)
    monkeypatch.setattr(recorded, "MOST", 2)
    both, other, _ = trained(tmp_path / "b", change=some_invalid, **short)
    assert tape is not None and other is not None
    assert (tape.records, other.records) == (1, 2) and other.replays > tape.replays
    assert_same(few, both)


def test_a_step_leaves_nothing_of_its_gradients_graph(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node that adds to a leaf's gradient keeps the stream that it was made on.

    Made in a usual step and still alive, it would take a recording to that stream, and break it.
    """
    terms_of, marked = step._terms, []

    def nodes(trainer: Trainer) -> list[dict[str, int]]:
        groups = [g for o in trainer.field.optimizers() for g in o.param_groups]
        leaves = [leaf for group in groups for leaf in group["params"]]
        return [leaf.expand_as(leaf).grad_fn.next_functions[0][0].metadata for leaf in leaves]

    def mark(trainer: Trainer) -> None:
        def marking(*arguments: Any) -> Any:
            for metadata in nodes(trainer):
                metadata["seen"] = 1
            marked.append([len(m) for m in nodes(trainer)])
            return terms_of(*arguments)

        monkeypatch.setattr(step, "_terms", marking)

    short = {"iterations": 2, "surfels": 60}
    trainer, *_ = trained(tmp_path, tape=None, change=mark, has_masks=False, **short)
    assert any(marked[0]) and len(marked) == 2  # those that the step uses were the same in it
    assert not any(nodes(trainer))
