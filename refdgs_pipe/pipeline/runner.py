"""Make what is missing."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from threading import Event as Flag
from time import monotonic
from typing import Any

from refdgs_pipe.errors import Cancelled, CorruptError
from refdgs_pipe.pipeline.atomic import disk_errors, remove
from refdgs_pipe.pipeline.events import (
    Damaged,
    Emit,
    Event,
    Fetched,
    Finished,
    Measured,
    Reused,
    Started,
    Warned,
)
from refdgs_pipe.pipeline.plan import Pipeline, Settings, Step
from refdgs_pipe.pipeline.shared import Shared, Sharing
from refdgs_pipe.pipeline.stage import Artifact, Job, Source, Stage
from refdgs_pipe.pipeline.store import Manifest, Origin, Record, load


@dataclass(frozen=True)
class Request:
    """What to make, and with what. Nothing here changes a result.

    Args:
        until: make only this stage and what it needs.
        force: make these again, even if they are up to date.
        device: asked once, when the first stage starts; gives "cpu" or "cuda".
        publish: stage name -> the folder of the workspace that shows its newest result.
        shared: results of other machines; what is there is not made.
    """

    until: str | None = None
    force: frozenset[str] = frozenset()
    device: Callable[[], str] = lambda: "cpu"
    threads: int = 1
    vram: int = 0
    cuda_graph: bool | None = None
    stop: Flag = field(default_factory=Flag)
    publish: Mapping[str, str] = field(default_factory=dict)
    shared: Shared | None = None


def run(
    pipeline: Pipeline,
    source: Source,
    settings: Settings,
    emit: Emit,
    request: Request | None = None,
) -> list[Step]:
    """Make what is missing, in order. Return the stages that were asked for, all done.

    Raises:
        WorkspaceBusy: another process is working in this workspace.
        WriteError: the disk is full or cannot be written.
        Cancelled: `stop` was set. Results committed before are kept.
    """
    request = request or Request()
    stages = pipeline.needed_for(request.until)
    with pipeline.store.lock():
        pipeline.store.sweep(pipeline.names)
        work = _Run(pipeline, source, settings, emit, request)
        while True:
            work.done.clear()
            try:
                return [work.make(stage) for stage in stages]
            except _DamagedResult as damage:
                work.set_aside(damage)


class _DamagedResult(Exception):
    """A result that was taken for whole is not."""

    def __init__(self, origin: Origin, reason: str) -> None:
        super().__init__(reason)
        self.origin = origin


class _Run:
    """One run: what is done so far, and what still has to be made again."""

    def __init__(
        self, pipeline: Pipeline, source: Source, settings: Settings, emit: Emit, request: Request
    ) -> None:
        self.pipeline, self.source, self.settings = pipeline, source, settings
        self.emit, self.request, self.store = emit, request, pipeline.store
        self.mark = pipeline.fingerprint(source)
        self.done: dict[type, Step] = {}
        self.to_force = set(request.force)
        self.reported: set[str] = set()  # stages that the listeners have heard of
        self.again: set[str] = set()  # keys of results that were set aside
        self.damages: dict[str, str] = {}  # stage -> what was wrong with its result
        self.device: str | None = None
        self.sharing = Sharing(request.shared, self.store, lambda s, words: emit(Warned(s, words)))

    def make(self, stage: Stage) -> Step:
        """The stage with its result, made now if it is not there."""
        if self.request.stop.is_set():
            raise Cancelled(f"stopped before {stage.name}")
        if stage.name in self.to_force:
            self.store.drop_adoption(stage.name)
        step = self.pipeline.step(stage, self._digests(), self.settings, self.mark)
        origin = step.origin
        assert origin is not None  # every earlier stage is done by now
        if step.state == "damaged":
            raise _DamagedResult(origin, step.reason.removeprefix("damaged: "))
        if step.manifest is None and stage.name not in self.to_force:
            step = self._fetch(step, origin)
        if step.manifest is None or stage.name in self.to_force:
            step = self._execute(step, origin)
        elif stage.name not in self.reported:
            self.reported.add(stage.name)
            self.store.drop_scratch(origin)
            self.emit(Reused(stage.name))
        self.store.use(origin)
        if step.manifest is not None:
            self.sharing.offer(step.manifest)
        if step.manifest and (name := self.request.publish.get(stage.name)):
            self._publish(origin, step.manifest, name)
        self.done[stage.output] = step
        return step

    def _fetch(self, step: Step, origin: Origin) -> Step:
        """The stage with its result from the shared ones; as it was if it is not there."""
        manifest = self.sharing.bring(origin)
        if manifest is None:
            return step
        self.reported.add(step.stage.name)
        self.emit(Fetched(step.stage.name, sum(size for size, _ in manifest.files.values())))
        return replace(step, state="up to date", reason="shared", manifest=manifest)

    def set_aside(self, damage: _DamagedResult) -> None:
        """Move a damaged result out of the way, so that it is made again."""
        if damage.origin.key in self.again:  # made anew and still not readable: a bug of the stage
            raise CorruptError(f"{damage.origin.stage}: {damage}, though it was made again")
        self.again.add(damage.origin.key)
        aside = self.store.set_aside(damage.origin)
        self.damages[damage.origin.stage] = f"damaged: {damage}"
        self.reported.discard(damage.origin.stage)
        self.emit(Damaged(damage.origin.stage, str(damage), aside.name))

    def _digests(self) -> dict[type, str]:
        made = {kind: step.manifest.digest for kind, step in self.done.items() if step.manifest}
        return {self.pipeline.source: self.mark.digest} | made

    def _execute(self, step: Step, origin: Origin) -> Step:
        """Run one stage and commit its result."""
        stage = step.stage
        inputs = self._inputs(stage)
        reason = self.damages.pop(stage.name, "asked for again" if step.manifest else step.reason)
        self.emit(Started(stage.name, reason, step.expected_s))
        listener = _Listener(self.emit)
        if self.device is None:
            self.device = self.request.device()
        start = monotonic()
        with disk_errors(self.store.root):
            folder, scratch = self.store.partial(origin), self.store.scratch(origin)
            job = Job(
                stage.name,
                folder,
                scratch,
                self.device,
                self.request.threads,
                listener,
                self.request.stop,
                self.request.vram,
                self.request.cuda_graph,
            )
            try:
                artifact: Artifact = stage.run(**inputs, params=self.settings[stage.name], job=job)
                artifact.save(folder)
                record = self._record(stage, monotonic() - start, listener)
                manifest = self.store.commit(folder, origin, record)
            except Exception:
                remove(folder)
                raise
        self.to_force.discard(stage.name)
        self.reported.add(stage.name)
        self.emit(Finished(stage.name, manifest.seconds))
        return replace(step, state="up to date", reason=reason, manifest=manifest)

    def _inputs(self, stage: Stage) -> dict[str, Any]:
        """The stage's inputs, read from disk after a check of every byte."""
        inputs: dict[str, Any] = {}
        for name, kind in stage.inputs.items():
            if kind is self.pipeline.source:
                inputs[name] = self.source
                continue
            step = self.done[kind]
            assert step.origin is not None and step.manifest is not None
            try:
                inputs[name] = load(kind, self.store.check(step.manifest))
            except CorruptError as error:
                raise _DamagedResult(step.origin, str(error)) from None
        return inputs

    def _record(self, stage: Stage, seconds: float, listener: "_Listener") -> Record:
        reads_source = self.pipeline.source in stage.inputs.values()
        files = self.mark.files if reads_source else {}
        made_on = [("device", str(self.device), "")] if stage.by_device else []
        measures = (*listener.measures, *made_on)
        return Record(seconds, files, measures, tuple(listener.warnings))

    def _publish(self, origin: Origin, manifest: Manifest, name: str) -> None:
        try:
            kept = self.store.publish(origin, manifest, name)
        except CorruptError as error:
            raise _DamagedResult(origin, str(error)) from None
        if kept:
            words = f"{name}/ held files that are not ours: the whole folder is kept as {kept}/"
            self.emit(Warned(origin.stage, words))


class _Listener:
    """Passes events on and keeps what belongs into the manifest."""

    def __init__(self, emit: Emit) -> None:
        self.emit = emit
        self.measures: list[tuple[str, float | int | str, str]] = []
        self.warnings: list[str] = []

    def __call__(self, event: Event) -> None:
        if isinstance(event, Measured):
            self.measures.append((event.name, event.value, event.unit))
        elif isinstance(event, Warned):
            self.warnings.append(event.text)
        self.emit(event)
