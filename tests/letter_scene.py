"""A folder of letters and a workspace over the small stages of `fake_stages`."""

from pathlib import Path
from typing import Any

from fake_stages import STAGES, Letters, Page, PrintParams, ReadParams, ShoutParams

from refdgs_pipe.pipeline.events import Event, Started
from refdgs_pipe.pipeline.plan import Pipeline
from refdgs_pipe.pipeline.runner import Request, run
from refdgs_pipe.pipeline.store import Store

SETTINGS = {"read": ReadParams(), "shout": ShoutParams(), "export": PrintParams()}
PUBLISH = {"export": "asset"}


class Scene:
    """A folder of letters and a workspace."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.letters = root / "letters"
        self.letters.mkdir(parents=True)
        for i, text in enumerate(("hello  there", "old", "world")):
            (self.letters / f"{i}.txt").write_text(text)
        self.source = Letters((self.letters,))
        self.pipeline = Pipeline(Letters, STAGES, Store(root / "work"))
        self.settings: dict[str, Any] = dict(SETTINGS)

    def run(self, **request: Any) -> list[Event]:
        log: list[Event] = []
        run(self.pipeline, self.source, self.settings, log.append, Request(**request))
        return log

    def reasons(self) -> dict[str, str]:
        mark = self.pipeline.fingerprint(self.source)
        return {s.stage.name: s.reason for s in self.pipeline.status(mark, self.settings)}

    def folder(self, name: str) -> Path:
        mark = self.pipeline.fingerprint(self.source)
        step = next(s for s in self.pipeline.status(mark, self.settings) if s.stage.name == name)
        assert step.origin is not None
        return self.pipeline.store.folder(step.origin)

    @property
    def page(self) -> str:
        return Page.load(self.folder("export")).text


def made(log: list[Event]) -> list[str]:
    return [event.stage for event in log if isinstance(event, Started)]
