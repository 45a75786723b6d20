"""Who hears what happens in a run: its log, the console, the forecast and the caller."""

from dataclasses import dataclass, field

from refdgs_pipe.cli.console import Console
from refdgs_pipe.cli.early import early_lines
from refdgs_pipe.cli.forecast import forecast
from refdgs_pipe.cli.logs import RunLog
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.pipeline.events import Emit, Event, Fetched, Finished, Reused, Started
from refdgs_pipe.pipeline.plan import Step

TRAINING = ("start", "train")  # the first stages that take long, whichever there is


@dataclass
class Listener:
    """Passes events on, and keeps what was made in how many seconds.

    Args:
        before: how the stages stood; names: those that the run is to bring up to date.
        cores: threads that the run may use.
        also: the caller's own listener.
    """

    space: Workspace
    console: Console
    log: RunLog
    before: list[Step]
    names: list[str]
    cores: int
    also: Emit
    made: dict[str, float] = field(default_factory=dict)
    _told_early: bool = False

    def __call__(self, event: Event) -> None:
        self.log(event)
        if isinstance(event, Started):
            self._before_stage(event.stage)
        elif isinstance(event, Reused | Fetched):
            self._drop(event.stage)
        self.console(event)
        self.also(event)
        if isinstance(event, Finished):
            self.made[event.stage] = event.seconds
            self._drop(event.stage)

    def _before_stage(self, stage: str) -> None:
        if stage in TRAINING and not self._told_early:
            self._told_early = True
            for line in early_lines(self.space):
                self.console.say(line)
        is_first = stage == self.space.pipeline.stages[0].name  # it reads the photos
        if self.console.forecast is None and not is_first and self.console.verbosity > 0:
            found = forecast(self.space, self.before, self.names, cores=self.cores)
            if found is not None:
                self.console.expect(found)

    def _drop(self, stage: str) -> None:
        if stage in self.names:
            self.names.remove(stage)
