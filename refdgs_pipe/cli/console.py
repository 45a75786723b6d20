"""Events to words: a live bar on a terminal, plain lines elsewhere. All on stderr."""

import sys
import time
from collections import deque
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

from refdgs_pipe.formatting import duration, figure, printable_lines
from refdgs_pipe.pipeline.events import (
    Damaged,
    Event,
    Finished,
    Measured,
    Progress,
    Reused,
    Started,
    Warned,
)

WINDOW_S = 30.0  # how far back the speed of a stage is measured
FIRST_LINE_S, LINE_S = 10.0, 30.0  # plain progress lines: the first, then one every so often
REFRESH_S = 0.1


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
        expected: how long each stage still to be made took last time, seconds; None: not known.
        verbosity: -1 silent, 0 warnings and errors only, 1 normal, 2 with every measured figure.
    """

    def __init__(self, expected: Mapping[str, float | None], *, verbosity: int = 1) -> None:
        self.verbosity = verbosity
        self._expected = dict(expected)
        self._estimate = Estimate()
        self._started = self._shown = 0.0
        self._first = True
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
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, event: Event) -> None:
        now = time.monotonic()
        if isinstance(event, Progress):
            self._progress(event, now)
        elif isinstance(event, Reused):
            self._expected.pop(event.stage, None)
            self.say(f"{event.stage}: up to date")
        elif isinstance(event, Started):
            self._expected.pop(event.stage, None)
            self._started, self._shown, self._first = now, now, True
            self.say(f"{event.stage}: {event.reason}")
            if self._bar is not None:
                self._task = self._bar.add_task(event.stage, total=None, note="", left="")
        elif isinstance(event, Measured):
            if self.verbosity > 1:
                unit = f" {event.unit}" if event.unit else ""
                self.say(f"{event.stage}: {event.name} {figure(event.value)}{unit}")
        elif isinstance(event, Warned):
            self.say(f"{event.stage}: warning: {event.text}", level=0)
        elif isinstance(event, Damaged):
            text = f"{event.reason}. Set aside as {event.aside}, made again"
            self.say(f"{event.stage}: warning: {text}", level=0)
        elif isinstance(event, Finished):
            self._drop_task()
            self.say(f"{event.stage}: done in {duration(event.seconds)}")

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
                    left=self._left(left),
                )
        elif now - self._shown >= (FIRST_LINE_S if self._first else LINE_S):
            self._shown, self._first = now, False
            count = f"{event.done}/{event.total}" if event.total else str(event.done)
            parts = [f"{event.stage}: {event.label} {count}", event.note, self._left(left)]
            self.say(", ".join(part for part in parts if part))

    def _left(self, stage_s: float | None) -> str:
        """Time to go: of this stage, and of the whole run where every later stage ran before."""
        if stage_s is None:
            return ""
        text = f"about {duration(stage_s)} left"
        later = list(self._expected.values())
        known = [seconds for seconds in later if seconds is not None]
        if later and len(known) == len(later):
            text += f", {duration(stage_s + sum(known))} in all"
        return text

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
