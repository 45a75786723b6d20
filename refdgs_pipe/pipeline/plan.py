"""Stages in order over one workspace: how they are wired, and how each of them stands."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Literal, TypeAlias

from refdgs_pipe.errors import CorruptError, InputError
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.atomic import disk_errors, remove
from refdgs_pipe.pipeline.fingerprint import Fingerprint, combine, fingerprint, hash_path
from refdgs_pipe.pipeline.reasons import why
from refdgs_pipe.pipeline.stage import Source, Stage
from refdgs_pipe.pipeline.store import Manifest, Origin, Record, Store, load

Settings: TypeAlias = Mapping[str, Params]  # stage name -> parameters
State: TypeAlias = Literal["up to date", "adopted", "missing", "stale", "damaged", "waiting"]

SOURCE_MEMORY = ".source.json"


@dataclass(frozen=True)
class Step:
    """A stage as it stands. `origin` is known once its inputs are; `manifest` if it is done."""

    stage: Stage
    state: State
    reason: str
    origin: Origin | None = None
    manifest: Manifest | None = None
    expected_s: float | None = None  # how long it took last time


class Pipeline:
    """Stages in order, over the store of one workspace.

    Raises:
        InputError: a stage takes an artifact that no earlier stage makes, or makes one made before.
    """

    def __init__(self, source: type[Source], stages: Sequence[Stage], store: Store) -> None:
        self.source, self.stages, self.store = source, tuple(stages), store
        self.makers: dict[type, Stage] = {}
        for stage in self.stages:
            for kind in stage.inputs.values():
                if kind is not source and kind not in self.makers:
                    raise InputError(f"no stage before {stage.name} makes its {kind.__name__}")
            if stage.output in self.makers:
                raise InputError(f"a stage before {stage.name} makes {stage.output.__name__} too")
            self.makers[stage.output] = stage

    def stage(self, name: str) -> Stage:
        """The stage of that name.

        Raises:
            InputError: there is none.
        """
        for stage in self.stages:
            if stage.name == name:
                return stage
        names = " ".join(stage.name for stage in self.stages)
        raise InputError(f"no stage is called {name!r}. There are: {names}")

    @property
    def names(self) -> list[str]:
        """The stages' names, in order."""
        return [stage.name for stage in self.stages]

    def needed_for(self, name: str | None) -> list[Stage]:
        """A stage and all that it builds on, in order. None: every stage."""
        if name is None:
            return list(self.stages)
        wanted = {self.stage(name).output}
        for stage in reversed(self.stages):
            if stage.output in wanted:
                wanted.update(stage.inputs.values())
        return [stage for stage in self.stages if stage.output in wanted]

    def following(self, name: str) -> frozenset[str]:
        """The names of a stage and of all that builds on it."""
        made = {self.stage(name).output}
        for stage in self.stages:
            if made & set(stage.inputs.values()):
                made.add(stage.output)
        return frozenset(stage.name for stage in self.stages if stage.output in made)

    def request(self, until: str | None, source: Fingerprint, settings: Settings) -> str:
        """One hash of all that a run up to a stage is made from: photos, settings, programs.

        While it stays the same, the run gives the same result, or fails for the same reason.
        """
        facts = {"source": source.digest}
        for stage in self.needed_for(until):
            programs = {name: _version(name) for name in stage.programs}
            params = settings[stage.name].hashed()[0]
            facts[stage.name] = json.dumps([stage.version, params, programs], sort_keys=True)
        return combine(facts)

    def fingerprint(self, source: Source) -> Fingerprint:
        """Hash the source; files with unchanged size and times are not read again."""
        last = self.last_fingerprint()
        memory = self.store.root / SOURCE_MEMORY
        return fingerprint(source.files(), memory, None if last is None else last.files)

    def forget_source(self) -> None:
        """Read every file of the source anew the next time."""
        (self.store.root / SOURCE_MEMORY).unlink(missing_ok=True)

    def last_fingerprint(self) -> Fingerprint | None:
        """The source as the last run saw it, for when it is not there any more."""
        last = self.store.current(self.stages[0].name)
        if last is None:
            return None
        digest = next(iter(last.origin.inputs.values()), "")
        return Fingerprint(digest, last.source_files)

    def status(self, source: Fingerprint, settings: Settings) -> list[Step]:
        """Every stage with its state. No result is read, only its record and its files' sizes."""
        digests: dict[type, str] = {self.source: source.digest}
        steps = []
        for stage in self.stages:
            step = self.step(stage, digests, settings, source)
            if step.manifest:
                digests[stage.output] = step.manifest.digest
            steps.append(step)
        return steps

    def step(
        self, stage: Stage, digests: Mapping[type, str], settings: Settings, source: Fingerprint
    ) -> Step:
        """How one stage stands, given the digests of what its inputs are."""
        last = self.store.current(stage.name)
        expected = last.seconds if last and not last.origin.adopted else None
        missing = [kind for kind in stage.inputs.values() if kind not in digests]
        if missing:
            makers = " and ".join(self.makers[kind].name for kind in missing)
            return Step(stage, "waiting", f"waits for {makers}", expected_s=expected)
        inputs = {name: digests[kind] for name, kind in stage.inputs.items()}
        programs = {name: _version(name) for name in stage.programs}
        plain, *others = (
            Origin(stage.name, stage.version, params, inputs, programs)
            for params in settings[stage.name].hashed()
        )
        plain = next((o for o in (plain, *others) if self.store.knows(o)), plain)
        origin = self.store.adoption(plain)
        try:
            manifest = self.store.find(origin)
        except CorruptError as error:
            return Step(stage, "damaged", f"damaged: {error}", origin, expected_s=expected)
        if manifest and origin.adopted:
            return Step(stage, "adopted", f"adopted from {manifest.note}", origin, manifest)
        if manifest:
            return Step(stage, "up to date", "up to date", origin, manifest, expected)
        makers_of = {n: self.makers[k].name for n, k in stage.inputs.items() if k in self.makers}
        former = settings[stage.name].former
        reason = why(plain, last, makers=makers_of, source_files=source.files, former=former)
        return Step(stage, "stale" if last else "missing", reason, plain, expected_s=expected)

    def adopt(self, name: str, file: Path, source: Fingerprint, settings: Settings) -> Manifest:
        """Let a user's file be the result of a stage, until what the stage works from changes.

        Raises:
            InputError: the stage cannot take a file, or its own inputs are not made yet.
        """
        stage = self.stage(name)
        read = getattr(stage.output, "adopt", None)
        if read is None:
            able = [s.name for s in self.stages if hasattr(s.output, "adopt")]
            raise InputError(f"{name} cannot adopt a file. These can: {' '.join(able) or 'none'}")
        if not file.exists():
            raise InputError(f"{file}: no such file")
        with self.store.lock():
            self.store.sweep(self.names)
            step = next(s for s in self.status(source, settings) if s.stage is stage)
            if step.origin is None:
                raise InputError(f"{name} {step.reason}. Make that first, with `run`")
            origin = replace(step.origin, adopted=hash_path(file))
            artifact = read(file)
            own = self.store.current(name)
            if own is not None and (check := getattr(artifact, "placed_like", None)):
                check(load(stage.output, self.store.check(own)))
            with disk_errors(self.store.root):
                folder = self.store.partial(origin)
                artifact.save(folder)
            manifest = self.store.commit(folder, origin, Record(0.0, {}, note=file.name))
            self.store.adopt(origin)
        return manifest

    def drop_adopted(self, name: str) -> bool:
        """Use a stage's own result again. False if none was adopted."""
        with self.store.lock():
            return self.store.drop_adoption(self.stage(name).name)

    def unused(self, source: Fingerprint, settings: Settings) -> list[Path]:
        """What neither the settings nor the last run used, and what dead runs left."""
        wanted = [step.origin for step in self.status(source, settings)]
        last = [self.store.current(stage.name) for stage in self.stages]
        used = [manifest.origin for manifest in last if manifest]
        return self.store.unused([*used, *(origin for origin in wanted if origin)], self.names)

    def clean(self, source: Fingerprint, settings: Settings) -> list[Path]:
        """Delete what is `unused`, and return it."""
        with self.store.lock(), disk_errors(self.store.root):
            self.store.sweep(self.names)
            unused = self.unused(source, settings)
            for path in unused:
                remove(path)
        return unused


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"
