"""What the logs of a workspace tell about its runs, read piece by piece as they grow."""

import json
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

Point: TypeAlias = tuple[int, float, float]  # step, loss, PSNR in dB
Event: TypeAlias = dict[str, Any]

TRAINED = ("train", "refine")  # the stages that train, one after the other
FIRST_STEPS = 50  # a training that told a step as early as this was not resumed
_LOGS = 10  # older logs tell nothing that is still shown
_MOST = 20_000_000  # bytes of one log that are read
_OF_USE = ("run", "started", "progress", "sampled", "finished", "failed")
_NAME = re.compile(r"[\w.-]+\.jsonl")


@dataclass(frozen=True)
class Story:
    """The newest run as its log tells it.

    Args:
        stage: the stage that began last and has not finished; None between stages.
        label, done, total: the stage's own progress, as far as it told any.
        begun, told: when the run began and when it last said something, seconds since 1970.
        stage_begun: when `stage` began.
        failure: the message that ended the run; "" if none did.
        curve: of the newest training, by step.
        steps: of the newest training in all, as planned; 0 if not known.
    """

    stage: str | None = None
    label: str = ""
    done: int | None = None
    total: int | None = None
    begun: float | None = None
    told: float | None = None
    stage_begun: float | None = None
    failure: str = ""
    curve: tuple[Point, ...] = ()
    steps: int = 0


@dataclass
class _Log:
    """One log, and how far it was read."""

    path: Path
    offset: int = 0
    rest: bytes = b""
    events: list[Event] = field(default_factory=list)  # those that are of use

    def read(self) -> bool:
        """Read what was added. Return whether anything was."""
        with suppress(OSError), self.path.open("rb") as file:
            file.seek(self.offset)
            new = file.read(_MOST - self.offset) if self.offset < _MOST else b""
            self.offset += len(new)
            *lines, self.rest = (self.rest + new).split(b"\n")
            for event in filter(None, map(_event, lines)):
                if self.events and event["event"] == self.events[-1]["event"] == "progress":
                    self.events.pop()  # only the last one tells something
                self.events.append(event)
            return bool(new)
        return False


class Logs:
    """The logs in a folder. A line is read once, however often they are looked at."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._logs: list[_Log] = []
        self._story = Story()

    def read(self) -> Story:
        """What they tell now; an empty story while there are none."""
        names: list[Path] = []
        with suppress(OSError):
            names = [path for path in self.folder.iterdir() if _NAME.fullmatch(path.name)]
        newest = sorted(names)[-_LOGS:]
        known = {log.path: log for log in self._logs}
        logs = [known.get(path) or _Log(path) for path in newest]
        is_changed = [log.path for log in logs] != [log.path for log in self._logs]
        self._logs = logs
        grown = [log.read() for log in logs if log is logs[-1] or not log.offset]
        if is_changed or any(grown):
            self._story = told([log.events for log in logs])
        return self._story


def told(runs: Sequence[Sequence[Event]]) -> Story:
    """The story of the last of some runs, each as its events; older ones give resumed curves."""
    if not runs:
        return Story()
    story = Story()
    for event in runs[-1]:
        if event["event"] != "sampled":
            story = _after(story, event)
    points, steps = _curve(runs)
    last = _time(runs[-1][-1]) if runs[-1] else None
    return replace(story, told=last, curve=points, steps=steps)


def _after(story: Story, event: Event) -> Story:
    """The story with one more event."""
    kind, now = event["event"], _time(event)
    stage = str(event.get("stage", ""))
    if kind == "run":
        return replace(story, begun=now)
    if kind == "started":
        return replace(
            story, stage=stage, stage_begun=now, label="", done=None, total=None, failure=""
        )
    if kind == "progress":
        with suppress(TypeError, ValueError):
            total = event.get("total")
            count = None if total is None else int(total)
            label = str(event.get("label", ""))
            return replace(story, label=label, done=int(event.get("done", 0)), total=count)
    if kind == "finished":
        return replace(story, stage=None, stage_begun=None, label="", done=None, total=None)
    if kind == "failed":
        return replace(story, failure=str(event.get("message", "")))
    return story


def _curve(runs: Sequence[Sequence[Event]]) -> tuple[tuple[Point, ...], int]:
    """The figures of the newest training, those of runs that it was resumed from included."""
    points: dict[int, Point] = {}
    steps = 0
    for run in reversed(runs):
        own = {point[0]: point for point in _points(run)}
        first = min(points, default=1 << 60)
        points |= {step: point for step, point in own.items() if step < first}
        steps = max([steps, *_planned(run)]) if own else steps
        begins = any(e["event"] == "started" and e.get("stage") == TRAINED[0] for e in run)
        if begins and (not own or min(own) <= FIRST_STEPS):
            break
    return tuple(points[step] for step in sorted(points)), steps


def _points(run: Iterable[Event]) -> Iterable[Point]:
    for event in run:
        if event["event"] == "sampled" and event.get("stage") in TRAINED:
            with suppress(ValueError, TypeError, KeyError):  # a log may be damaged
                figures = event["figures"]
                yield int(event["step"]), float(figures["loss"]), float(figures["psnr"])


def _planned(run: Iterable[Event]) -> Iterable[int]:
    for event in run:
        if event["event"] == "sampled" and event.get("stage") in TRAINED:
            with suppress(ValueError, TypeError, KeyError):
                yield int(event["steps"])


def _event(line: bytes) -> Event | None:
    with suppress(ValueError, RecursionError):
        found = json.loads(line.decode("utf-8", "replace"))
        if isinstance(found, dict) and found.get("event") in _OF_USE:
            return found
    return None


def _time(event: Event) -> float | None:
    with suppress(TypeError, ValueError, KeyError):
        return float(event["time"])
    return None
