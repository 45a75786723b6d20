"""What a workspace holds, as the report needs it: each stage's result, and what the logs say."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.errors import InputError, RefdgsError
from refdgs_pipe.pipeline.plan import Step
from refdgs_pipe.pipeline.stage import Artifact
from refdgs_pipe.pipeline.store import Manifest, Store, load

T = TypeVar("T", bound=Artifact)
Point: TypeAlias = tuple[int, float, float]  # step, loss, PSNR in dB
TRAINED = ("train", "refine")  # the stages that train, one after the other
FIRST_STEPS = 50  # a stage that told a step as early as this was not resumed


@dataclass(frozen=True)
class Result:
    """A stage and its newest result.

    Args:
        state, reason: how it stands, as `status` says.
        manifest, folder: None if it never ran.
    """

    step: Step
    manifest: Manifest | None
    folder: Path | None

    @property
    def name(self) -> str:
        return self.step.stage.name

    @property
    def is_current(self) -> bool:
        """Whether it is what the settings and photos of now would give."""
        return self.step.manifest is not None

    @property
    def measures(self) -> dict[str, tuple[float | int | str, str]]:
        """Figure -> (value, unit), as the stage reported them."""
        found = self.manifest.measures if self.manifest else ()
        return {name: (value, unit) for name, value, unit in found}


@dataclass(frozen=True)
class Failure:
    """How the last run ended badly: the stage that was running, if any, and the message."""

    stage: str | None
    message: str


@dataclass(frozen=True)
class Notes:
    """What the logs tell.

    Args:
        made: the stages that the last run which made anything made; the others were reused.
        failure: of the last run; None if it went well.
        curve: (step, loss, PSNR in dB) of the training that gave the current field.
    """

    made: frozenset[str] = frozenset()
    failure: Failure | None = None
    curve: tuple[Point, ...] = ()


@dataclass(frozen=True)
class Drawing:
    """How pictures are drawn: on the CPU, with so many threads. It does not change them."""

    threads: int = 1


@dataclass(frozen=True)
class Facts:
    """All that the report is made of.

    Args:
        title: the workspace's name.
        recipe: its name, without a path.
        changed: the `stage.key=value` that differ from the recipe.
        settings: stage -> setting -> value.
        draft: whether the recipe is meant for a first look.
        check: raises CorruptError for a result whose files are not as they were written.
    """

    title: str
    recipe: str
    changed: tuple[str, ...]
    settings: dict[str, dict[str, Any]]
    results: tuple[Result, ...]
    notes: Notes
    private: tuple[str, ...] = field(default=(), repr=False)
    draft: bool = False
    check: Callable[[Manifest], Path] | None = field(default=None, repr=False)

    def result(self, kind: type[Artifact]) -> Result | None:
        """The result of the stage that makes this kind, or None if it never ran."""
        for result in self.results:
            if result.step.stage.output is kind and result.manifest is not None:
                return result
        return None

    def maker(self, kind: type[Artifact]) -> str:
        """The name of the stage that makes this kind; the kind's own if there is no such stage."""
        stages = [result.step.stage for result in self.results]
        return next((stage.name for stage in stages if stage.output is kind), kind.__name__)

    def folder(self, kind: type[Artifact]) -> Path:
        """Where the artifact of this kind is.

        Raises:
            InputError: there is none.
        """
        result = self.result(kind)
        if result is None or result.folder is None or result.manifest is None:
            raise InputError(f"no stage has made its {kind.__name__} yet")
        return result.folder

    def load(self, kind: type[T]) -> T:
        """The artifact of this kind, read from disk once.

        Raises:
            InputError: there is none.
            CorruptError: it is damaged.
        """
        if kind not in self._loaded:
            folder, result = self.folder(kind), self.result(kind)
            if self.check and result and result.manifest and kind is not Asset:
                self.check(result.manifest)  # of an asset the page tells file by file
            self._loaded[kind] = load(kind, folder)
        found: T = self._loaded[kind]
        return found

    @cached_property
    def _loaded(self) -> dict[type, Any]:
        return {}

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """(stage, words) of what the stages of the current results warned about."""
        return [
            (result.name, self.plain(text))
            for result in self.results
            if result.manifest
            for text in result.manifest.warnings
        ]

    @property
    def missing(self) -> list[str]:
        """The stages without any result."""
        return [result.name for result in self.results if result.manifest is None]

    def plain(self, text: str) -> str:
        """A text without the folders of this machine: reports are passed on."""
        for place in self.private:
            text = text.replace(place + "/", "")
        return text


def collect(
    store: Store, steps: Sequence[Step], *, about: dict[str, Any], private: Sequence[Path] = ()
) -> Facts:
    """The facts of a workspace.

    Args:
        about: `recipe`, `changed`, `settings` and `draft` of Facts.
        private: folders whose names are taken out of messages.
    """
    results = []
    for step in steps:
        manifest = step.manifest or store.current(step.stage.name)
        folder = None if manifest is None else store.folder(manifest.origin)
        results.append(Result(step, manifest, folder))
    places = sorted({str(path) for path in private if len(path.parts) > 1}, key=len, reverse=True)
    return Facts(
        title=store.root.name.removesuffix(".refdgs"),
        results=tuple(results),
        notes=read_notes(store.root / "logs", results),
        private=tuple(places),
        check=store.check,
        **about,
    )


def read_notes(folder: Path, results: Sequence[Result]) -> Notes:
    """What the logs in a folder tell about these results."""
    runs = [list(_events(path)) for path in sorted(folder.glob("*.jsonl"))]
    runs = [run for run in runs if run]
    made: frozenset[str] = frozenset()
    for run in runs:
        finished = frozenset(str(e.get("stage")) for e in run if e["event"] == "finished")
        made = finished or made
    done = {result.name: result.manifest for result in results if result.manifest}
    curve: tuple[Point, ...] = ()
    for stage in TRAINED:
        if stage in done:
            curve += _curve(runs, stage, done[stage].seconds, after=curve[-1][0] if curve else 0)
    return Notes(made, _failure(runs[-1]) if runs else None, curve)


def _failure(run: list[dict[str, Any]]) -> Failure | None:
    """The error that ended a run; being stopped by the user is none."""
    errors = [event for event in run if event["event"] == "failed"]
    if not errors or errors[-1].get("kind") == "Cancelled":
        return None
    started = [e.get("stage") for e in run if e["event"] == "started"]
    done = {e.get("stage") for e in run if e["event"] == "finished"}
    stage = next((str(name) for name in reversed(started) if name not in done), None)
    return Failure(stage, str(errors[-1].get("message", "")))


def _curve(
    runs: list[list[dict[str, Any]]], stage: str, seconds: float, *, after: int
) -> tuple[Point, ...]:
    """A stage's figures in the run that finished it, and in those it was resumed from.

    Args:
        after: the last step of the stage before.
    """
    points: dict[int, Point] = {}
    is_found = False
    for run in reversed(runs):
        ends = [e for e in run if e["event"] == "finished" and e.get("stage") == stage]
        if not is_found:
            is_found = any(e.get("seconds") == seconds for e in ends)
            if not is_found:
                continue
        elif ends:  # an older training that came to its end
            break
        before = min(points, default=1 << 60)
        points |= {point[0]: point for point in _points(run, stage) if after < point[0] < before}
        if not points or min(points) <= after + FIRST_STEPS:
            break
    return tuple(points[step] for step in sorted(points))


def _points(run: list[dict[str, Any]], stage: str) -> Iterator[Point]:
    for event in run:
        if event["event"] == "sampled" and event.get("stage") == stage:
            with suppress(ValueError, TypeError, KeyError):  # a log may be damaged
                figures = event["figures"]
                yield int(event["step"]), float(figures["loss"]), float(figures["psnr"])


def _events(path: Path) -> Iterator[dict[str, Any]]:
    """The events of a log; lines that a crash cut short are left out."""
    with suppress(OSError):
        for line in path.read_text("utf-8", errors="replace").splitlines():
            with suppress(ValueError):
                record = json.loads(line)
                if isinstance(record, dict) and "event" in record:
                    yield record


def readable(error: Exception) -> str:
    """An error in one line, for the place where its section would be."""
    if isinstance(error, RefdgsError):
        return str(error)
    return f"{type(error).__name__}: {error}".splitlines()[0]
