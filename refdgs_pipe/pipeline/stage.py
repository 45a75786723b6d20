"""What a stage is: a function from artifacts and parameters to one artifact."""

from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event as Flag
from typing import Any, Protocol, Self, TypeVar, get_type_hints

from refdgs_pipe.errors import Cancelled
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.events import Emit, Measured, Progress, Sampled, Warned

T = TypeVar("T")


class Artifact(Protocol):
    """Data that one stage makes and later stages read, stored as one folder."""

    def save(self, folder: Path) -> None: ...

    @classmethod
    def load(cls, folder: Path) -> Self: ...


class Source(Protocol):
    """The user's files, which no stage makes."""

    def files(self) -> Sequence[tuple[str, Path]]:
        """Every file that would be read, as (name relative to the source, path)."""
        ...


@dataclass(frozen=True)
class Job:
    """What a running stage may use besides its inputs. Nothing here may change the result."""

    stage: str
    folder: Path  # where the output is built; starts empty
    scratch: Path  # survives an interruption, gone once the output is committed
    device: str  # "cpu" or "cuda"
    threads: int
    emit: Emit
    stop: Flag = field(default_factory=Flag)
    vram: int = 0  # bytes of GPU memory to keep within, 0: all that is free
    cuda_graph: bool | None = None  # repeat recorded GPU steps; None: where they prove equal

    def track(self, items: Iterable[T], label: str) -> Iterator[T]:
        """Yield the items, reporting progress. Every step is a safe point to cancel.

        Raises:
            Cancelled: the user asked to stop.
        """
        total = len(items) if isinstance(items, Sized) else None
        done = 0
        for done, item in enumerate(items):
            self.progress(label, done, total)
            yield item
        self.progress(label, total or done, total)

    def progress(
        self, label: str, done: int, total: int | None, note: str = "", work: float | None = None
    ) -> None:
        """Report progress, for loops that `track` does not fit.

        Args:
            work: 0 to 1, where steps differ in cost; the time left is estimated from it.

        Raises:
            Cancelled: the user asked to stop.
        """
        if self.stop.is_set():
            raise Cancelled(f"stopped during {label}")
        self.emit(Progress(self.stage, label, done, total, note, work))

    def sample(self, step: int, steps: int, **figures: float) -> None:
        """Tell figures as they are at one of the stage's steps; the log keeps them as a curve."""
        self.emit(Sampled(self.stage, step, steps, figures))

    def measure(self, name: str, value: float | int | str, unit: str = "") -> None:
        """Record a figure about the result; it is kept in the manifest."""
        self.emit(Measured(self.stage, name, value, unit))

    def warn(self, text: str) -> None:
        """Tell the user that the result is degraded, and why; it is kept in the manifest."""
        self.emit(Warned(self.stage, text))


@dataclass(frozen=True)
class Stage:
    """A declared stage. `inputs` maps each argument to the type of artifact it takes."""

    name: str
    version: int
    inputs: dict[str, type[Any]]  # artifacts, or the source
    params: type[Params]
    output: type[Artifact]
    run: Callable[..., Artifact]
    programs: tuple[str, ...] = ()  # distributions whose version is part of the key
    by_device: bool = False  # CPU and GPU give slightly different results; the record says which


def stage(
    version: int, programs: tuple[str, ...] = (), *, by_device: bool = False
) -> Callable[[Callable[..., Any]], Stage]:
    """Declare a stage. Its signature says the rest: artifacts, `params` and `job` in, artifact out.

    Raise `version` whenever equal inputs and parameters would give a different result.
    `programs` names the installed distributions ("pycolmap") whose versions join the key.
    `by_device`: a GPU gives a slightly different result, so the record names the device.
    """

    def declare(run: Callable[..., Any]) -> Stage:
        types = get_type_hints(run)
        output, params, _ = types.pop("return"), types.pop("params"), types.pop("job")
        return Stage(run.__name__, version, types, params, output, run, programs, by_device)

    return declare
