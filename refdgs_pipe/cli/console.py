"""Events to words: a live bar on a terminal, plain lines elsewhere. All on stderr."""

import sys
import time
from collections import deque
from types import TracebackType
from typing import Any, Self

from refdgs_pipe.cli.forecast import Forecast
from refdgs_pipe.formatting import duration, figure, merged, printable_lines, roughly, size
from refdgs_pipe.pipeline.events import (
    Damaged,
    Event,
    Fetched,
    Finished,
    Measured,
    Progress,
    Reused,
    Started,
    Warned,
)
from refdgs_pipe.stage_words import doing

WINDOW_S = 30.0  # how far back the speed of a stage is measured
FIRST_LINE_S, LINE_S = 10.0, 30.0  # plain progress lines: the first, then one every so often
REFRESH_S = 0.1
NEVER_RUN = "never run"  # a reason that nobody needs to read
TRAINING, RESUMED = "training", 50  # a training whose first step is later than this goes on


class Estimate:
    """The time that a running stage still needs, from its speed in the last half minute."""

    def __init__(self) -> None:
        self._label = ""
        self._seen: deque[tuple[float, float]] = deque()

    def remaining_s(self, event: Progress, now: float) -> float | None:
        """Seconds to go, or None while nothing can be said."""
        if event.label != self._label:
            self._label = event.label
            self._seen.clear()
        behind: float = event.done if event.work is None else event.work
        total = event.total if event.work is None else 1.0
        self._seen.append((now, behind))
        while len(self._seen) > 2 and self._seen[1][0] < now - WINDOW_S:
            self._seen.popleft()
        since, before = self._seen[0]
        if total is None or behind <= before or now - since < 1.0:
            return None
        return (total - behind) * (now - since) / (behind - before)


class Console:
    """Speaks to the user about one run.

    Args:
        verbosity: -1 silent, 0 warnings and errors only, 1 normal, 2 with every measured figure.
    """

    def __init__(self, *, verbosity: int = 1) -> None:
        self.verbosity = verbosity
        self.forecast: Forecast | None = None  # of the whole run, once that can be told
        self._estimate = Estimate()
        self._started = self._shown = 0.0
        self._first = True
        self._label = ""
        self._warnings: list[str] = []
        self._bar: Any = None
        self._task: Any = None
        if verbosity > 0 and sys.stderr.isatty():
            self._bar = _make_bar()

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._drop_task()
        for text in merged(self._warnings):  # of a stage that an error ended
            self.say(f"warning: {text}", level=0)
        self._warnings.clear()
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, event: Event) -> None:
        now = time.monotonic()
        if isinstance(event, Warned):
            self._warnings.append(event.text)
            return
        if self._warnings:
            self._tell_warnings(event.stage)
        if isinstance(event, Progress):
            self._progress(event, now)
        elif isinstance(event, Reused):
            if self.forecast is not None:
                self.forecast.modelled.pop(event.stage, None)
            self.say(f"{event.stage}: up to date")
        elif isinstance(event, Fetched):
            if self.forecast is not None:
                self.forecast.modelled.pop(event.stage, None)
            self.say(f"{event.stage}: fetched, {size(event.size)}")
        elif isinstance(event, Started):
            self._started, self._shown, self._first, self._label = now, now, True, ""
            why = "" if event.reason == NEVER_RUN else f" ({event.reason})"
            self.say(f"{event.stage}: {doing(event.stage)}{why}")
            if self._bar is not None:
                self._task = self._bar.add_task(event.stage, total=None, note="", left="")
        elif isinstance(event, Measured):
            if self.verbosity > 1:
                unit = f" {event.unit}" if event.unit else ""
                self.say(f"{event.stage}: {event.name} {figure(event.value)}{unit}")
        elif isinstance(event, Damaged):
            text = f"{event.reason}. Set aside as {event.aside}, made again"
            self.say(f"{event.stage}: warning: {text}", level=0)
        elif isinstance(event, Finished):
            self._drop_task()
            if self.forecast is not None:
                self.forecast.finished(event.stage, event.seconds)
            self.say(f"{event.stage}: done in {duration(event.seconds)}")

    def expect(self, forecast: Forecast) -> None:
        """From now on the time left is that of the whole run."""
        self.forecast = forecast
        for line in forecast.lines():
            self.say(line)

    def _tell_warnings(self, stage: str) -> None:
        """Equal warnings that came one after the other are one sentence."""
        for text in merged(self._warnings):
            self.say(f"{stage}: warning: {text}", level=0)
        self._warnings.clear()

    def say(self, text: str, level: int = 1) -> None:
        """Print a line above the bar."""
        if self.verbosity < level:
            return
        text = printable_lines(text)
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(text, file=sys.stderr, flush=True)

    def _progress(self, event: Progress, now: float) -> None:
        if event.label != self._label:
            self._label = event.label
            if event.label == TRAINING and event.done >= RESUMED:
                self.say(f"{event.stage}: {event.label} from step {event.done}")
        left = self._estimate.remaining_s(event, now)
        if self._bar is not None:
            if now - self._shown >= REFRESH_S or event.done == event.total:
                self._shown = now
                self._bar.update(
                    self._task,
                    description=f"{event.stage}: {event.label}",
                    total=event.total,
                    completed=event.done,
                    note=event.note,
                    left=self._left(event, left, now),
                )
        elif now - self._shown >= (FIRST_LINE_S if self._first else LINE_S):
            self._shown, self._first = now, False
            count = f"{event.done}/{event.total}" if event.total else str(event.done)
            left_words = self._left(event, left, now)
            parts = [f"{event.stage}: {event.label} {count}", event.note, left_words]
            self.say(", ".join(part for part in parts if part))

    def _left(self, event: Progress, part_s: float | None, now: float) -> str:
        """Time to go until the end of the run; of this part of a stage while that is not known."""
        if self.forecast is None:
            is_over = part_s is None or event.done == event.total
            return "" if part_s is None or is_over else f"{roughly(part_s)} left in this part"
        spent, sure = now - self._started, event.work is not None
        whole = self.forecast.left_s(event.stage, spent, part_s, sure=sure)
        return f"{roughly(whole)} left in all"

    def _drop_task(self) -> None:
        if self._bar is not None and self._task is not None:
            self._bar.remove_task(self._task)
            self._task = None


def _make_bar() -> Any:
    """A live line at the bottom of the terminal. NO_COLOR and TERM=dumb are rich's business."""
    from rich.console import Console as RichConsole
    from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn
    from rich.progress import Progress as Bar

    return Bar(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TextColumn("{task.fields[left]}"),
        console=RichConsole(stderr=True),
        transient=True,
    )
