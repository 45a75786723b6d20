"""How long a run still takes: all its stages and the report, in one figure.

The model of checking/cost.py says how the stages compare. What the finished stages of this run
took says how fast this machine is now. A stage that ran here before with the same settings takes
what it took then, and the running stage what its own progress tells.
"""

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import exp, log
from typing import TYPE_CHECKING

from refdgs_pipe.cli.device import core_count
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.errors import RefdgsError
from refdgs_pipe.formatting import about_room, aligned, roughly
from refdgs_pipe.pipeline.plan import Step
from refdgs_pipe.stage_words import doing

if TYPE_CHECKING:
    from refdgs_pipe.checking.cost import Capture

REPORT = "report"
REPORT_S = 20.0  # core-seconds to draw it
PRIOR_S = 40.0  # modelled seconds for which the machine's load before the run counts
LEAST_S = 0.5  # that a stage takes in a forecast
BUSY = 2.0  # that people are told of
# The weight of a stage, if it is not 1. How long photos take to place depends on the photos: it
# differed by a factor of 2.3 where others differed by 1.3 (docs/experiments/time-estimates.md).
TELLING = {"sfm": 0.1}
OVERDUE = 0.2  # of the time a stage took so far: what it still takes when it should be over


@dataclass
class Forecast:
    """The time that a run still takes. It is corrected with every stage that ends.

    Args:
        modelled: stage -> seconds by the model, of every stage that is still to be made.
        room: bytes of the finished workspace, as far as they can be told.
        busy: how many times as long as on an idle machine work takes, before any is measured.
    """

    modelled: dict[str, float]
    room: int | None = None
    busy: float = 1.0
    _weight: float = 0.0  # of what finished stages told
    _told: float = 0.0  # the logarithm of the slowness, times that weight

    @property
    def slowness(self) -> float:
        """How many times as long as in the model this machine takes now.

        The mean of the stages' logarithms, weighted by their modelled time. So one stage that took
        five times as long does not make the whole machine five times as slow.
        """
        return exp((PRIOR_S * log(self.busy) + self._told) / (PRIOR_S + self._weight))

    def expect(self, stage: str) -> float:
        """Seconds of a stage that has not begun."""
        return max(self.modelled.get(stage, 0.0) * self.slowness, LEAST_S)

    def finished(self, stage: str, seconds: float) -> None:
        """A stage is made. How long it took tells how fast the machine is."""
        modelled = self.modelled.pop(stage, None)
        if modelled:
            weight = modelled * TELLING.get(stage, 1.0)
            self._told += weight * log(max(seconds, LEAST_S / 10) / modelled)
            self._weight += weight

    def left_s(self, running: str, spent_s: float, told_s: float | None, *, sure: bool) -> float:
        """Seconds until the end of the run.

        Args:
            running: the stage that is running; spent_s: for so long.
            told_s: what its progress says that it still takes; None: nothing yet.
            sure: its progress is about all of it, not about one of several parts.
        """
        mine = self.expect(running) - spent_s
        if told_s is not None:
            mine = told_s if sure else max(told_s, mine)
        mine = max(mine, OVERDUE * spent_s if told_s is None else 0.0)
        return mine + sum(self.expect(name) for name in self.modelled if name != running)

    def lines(self) -> list[str]:
        """The whole run and each of its stages, for people, before the work begins."""
        whole = sum(self.expect(stage) for stage in self.modelled)
        head = f"the rest of the run takes {roughly(whole)}"
        if self.room is not None:
            head += f" and fills {about_room(self.room)} of the disk"
        if self.busy >= BUSY:
            head += f" (other work makes this machine about {self.busy:.0f} times as slow)"
        rows = [(name, roughly(self.expect(name)), doing(name)) for name in self.modelled]
        return [f"{head}:", *aligned(rows, before="  ")]


def forecast(
    space: Workspace, steps: Iterable[Step], wanted: Iterable[str], *, cores: int
) -> Forecast | None:
    """The forecast for the stages in `wanted`; None while the photos are not read.

    Args:
        steps: how the stages stand, as `Workspace.status` has it.
    """
    from refdgs_pipe.checking.cost import room, seconds_of, works

    capture = _capture(space)
    if capture is None:
        return None
    try:
        work = works(capture, space.settings)
        filled = room(capture, space.settings)
    except (KeyError, AttributeError, StopIteration):  # a pipeline of other stages
        return None
    before = _before(space, steps)
    names = list(wanted)
    modelled = {
        name: before.get(name) or max(seconds_of(work.get(name, 0.0), cores), LEAST_S)
        for name in names
    }
    return Forecast(modelled | {REPORT: seconds_of(REPORT_S, cores)}, filled, _busy())


def _busy() -> float:
    """How many times as long work takes now, by the load of the last minute."""
    with suppress(OSError):
        return max(1.0, os.getloadavg()[0] / core_count())
    return 1.0


def _before(space: Workspace, steps: Iterable[Step]) -> Mapping[str, float]:
    """Stage -> seconds that it took here with the settings that it has now."""
    found = {}
    for step in steps:
        name = step.stage.name
        last = space.pipeline.store.current(name)
        same = last is not None and last.origin.params in space.settings[name].hashed()
        if step.expected_s and same:
            found[name] = step.expected_s
    return found


def _capture(space: Workspace) -> "Capture | None":
    """The photos as the stage that reads them left them; None if it did not run yet."""
    from refdgs_pipe.artifacts.views import Views
    from refdgs_pipe.checking.cost import Capture

    store = space.pipeline.store
    for stage in space.pipeline.stages:
        manifest = store.current(stage.name) if stage.output is Views else None
        if manifest is None:
            continue
        try:
            views = Views.load(store.folder(manifest.origin))
        except (RefdgsError, OSError):
            return None
        if not views.items:
            return None
        first = views.items[0]
        sides = sorted((first.width, first.height))
        return Capture(
            photos=len(views.items),
            megapixels=None if first.placing else first.width * first.height / 1e6,
            shape=sides[0] / sides[1],
            is_known=views.has_known_poses,
            has_masks=views.background != "photo",
        )
    return None
