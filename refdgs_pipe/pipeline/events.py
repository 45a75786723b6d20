"""What happens during a run, as data. Stages emit events; the console, log and viewer listen."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True)
class Reused:
    """A stage's result was there already."""

    stage: str


@dataclass(frozen=True)
class Started:
    """`expected_s` is how long it took last time here, None if it never ran."""

    stage: str
    reason: str
    expected_s: float | None = None


@dataclass(frozen=True)
class Progress:
    """`done` of `total` steps (None: not known) of the running stage.

    `work`, 0 to 1, is the share of the time that should be behind, where steps differ in cost.
    """

    stage: str
    label: str
    done: int
    total: int | None
    note: str = ""  # live figures for people; programs read `Sampled`
    work: float | None = None


@dataclass(frozen=True)
class Sampled:
    """Figures of the running stage as they are at one of its steps: the points of its curves."""

    stage: str
    step: int
    steps: int
    figures: Mapping[str, float]  # name -> value


@dataclass(frozen=True)
class Measured:
    """A figure about the result, kept in its manifest. `unit` is "" for pure numbers."""

    stage: str
    name: str
    value: float | int | str
    unit: str = ""


@dataclass(frozen=True)
class Warned:
    """Something the user should know, kept in the manifest: the result is degraded, not wrong."""

    stage: str
    text: str


@dataclass(frozen=True)
class Damaged:
    """A result on disk is not what was written. It was moved to `aside` and is made again."""

    stage: str
    reason: str
    aside: str


@dataclass(frozen=True)
class Fetched:
    """A stage's result came from the shared ones; `size` is its bytes."""

    stage: str
    size: int


@dataclass(frozen=True)
class Finished:
    stage: str
    seconds: float


Event: TypeAlias = (
    Reused | Fetched | Started | Progress | Sampled | Measured | Warned | Damaged | Finished
)
Emit: TypeAlias = Callable[[Event], None]
