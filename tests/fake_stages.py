"""Small stages with the shape of the real ones, for tests of the engine and the command line."""

import fcntl
import json
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

from pydantic import Field

from refdgs_pipe.errors import CaptureError, MeshError, TrainingError
from refdgs_pipe.params import Former, Params
from refdgs_pipe.pipeline.stage import Job, Stage, stage


@dataclass(frozen=True)
class Letters:
    """The source: text files."""

    paths: tuple[Path, ...]

    def files(self) -> list[tuple[str, Path]]:
        for path in self.paths:
            if not path.exists():
                raise CaptureError(f"{path}: no such file or folder")
        found = [
            f for path in self.paths for f in (sorted(path.iterdir()) if path.is_dir() else [path])
        ]
        if not found:
            raise CaptureError(f"{self.paths[0]}: nothing in it")
        return [(path.name, path) for path in found]


@dataclass(frozen=True)
class Text:
    text: str

    def save(self, folder: Path) -> None:
        (folder / "text").write_text(self.text)
        (folder / "parts").mkdir()
        for i, word in enumerate(self.text.split()[:5]):
            (folder / "parts" / f"{i}.bin").write_bytes(word.encode() * 1000)

    @classmethod
    def load(cls, folder: Path) -> Self:
        return cls((folder / "text").read_text())


class Words(Text):
    pass


class Shout(Text):
    @classmethod
    def adopt(cls, path: Path) -> Self:
        return cls(path.read_text())


class Page(Text):
    pass


class ReadParams(Params):
    """How letters are read."""

    keep_spaces: bool = Field(False, description="whether spaces stay as they are, yes or no")


class ShoutParams(Params):
    """How loud."""

    former: ClassVar[Mapping[str, Former]] = {
        "volume": Former(("low", "high"), "the option --cuda-graph")
    }

    marks: int = Field(1, ge=0, le=9, description="exclamation marks, a count")
    mood: str = Field("calm", max_length=20, description="how it feels, a word")


class PrintParams(Params):
    """How a page looks."""

    width: float = Field(20.0, gt=1, lt=100, description="width of the page, in letters")


@stage(version=1, programs=("pydantic",))
def read(letters: Letters, params: ReadParams, job: Job) -> Words:
    """Read all letters."""
    texts = [path.read_text() for _, path in job.track(letters.files(), "reading")]
    if "unusable" in texts:
        raise CaptureError("letter 1 is unusable")
    if "bug" in texts:
        raise KeyError("a mistake of ours")
    for text in texts:
        if text == "fail 0":
            raise MemoryError
        if text.startswith("fail "):
            raise OSError(int(text[5:]), "failing", "a.txt")
    text = " ".join(texts)
    job.measure("letters", len(texts))
    if "odd" in text:
        job.warn("an odd letter")
    return Words(text if params.keep_spaces else " ".join(text.split()))


@stage(version=1)
def shout(words: Words, params: ShoutParams, job: Job) -> Shout:
    """Work in small steps with checkpoints, like training."""
    if "FAKE_ALONE" in os.environ:  # held until the process ends: two at once are a mistake
        alone = os.open(job.scratch / "alone", os.O_RDWR | os.O_CREAT)
        fcntl.flock(alone, fcntl.LOCK_EX | fcntl.LOCK_NB)
    note = job.scratch / "done"
    done = int(note.read_text()) if note.exists() else 0
    pause_s = float(os.environ.get("FAKE_STEP_S", "0"))
    for step in range(done, 10):
        job.progress("shouting", step, 10, note=f"loudness {step}")
        time.sleep(pause_s)
        (job.scratch / "new").write_text(str(step + 1))
        (job.scratch / "new").replace(note)
    job.measure("resumed at", done)
    if job.cuda_graph is not None:
        job.measure("recorded", str(job.cuda_graph))
    if params.mood == "mute":
        raise MeshError("no voice. Set shout.mood")
    return Shout(words.text.upper() + "!" * params.marks)


@stage(version=1)
def export(shout: Shout, words: Words, params: PrintParams, job: Job) -> Page:
    """Print the page."""
    job.measure("faces", 12)
    return Page(f"{shout.text} ({words.text}) {params.width}")


class Marks(Text):
    """Scores, as generic as they come."""

    def save(self, folder: Path) -> None:
        views = [{"name": "a", "psnr": 1.0}]
        seed, scene = self.text.split(maxsplit=1)
        mean = {"psnr": 20.0 + int(seed) + len(scene), "ssim": None}
        surface = {"chamfer": 0.5 / (1 + int(seed)), "is_closed": True}
        text = json.dumps({"mean": mean, "surface": surface, "views": views, "notes": {"a": "b"}})
        (folder / "scores.json").write_text(text)

    @classmethod
    def load(cls, folder: Path) -> Self:
        return cls((folder / "scores.json").read_text())


class Seeded(Text):
    pass


class StartParams(Params):
    """How training starts."""

    seed: int = Field(0, ge=0, description="of all random choices")


class TrainParams(Params):
    """Training."""

    mood: str = Field("calm", max_length=20, description="how it feels, a word")


class ScoreParams(Params):
    """Scoring."""


@stage(version=1)
def start(words: Words, params: StartParams, job: Job) -> Seeded:
    """Put the seed in front."""
    return Seeded(f"{params.seed} {words.text}")


@stage(version=1)
def train(seeded: Seeded, params: TrainParams, job: Job) -> Shout:
    """Fail where the scene or the mood says so, else shout."""
    seed, _, text = seeded.text.partition(" ")
    words = Words(text)
    if "diverging" in words.text:
        raise TrainingError("training diverged | at step 3")
    if "native" in words.text:
        raise ZeroDivisionError("a mistake of ours")
    made = shout.run(words=words, params=ShoutParams(mood=params.mood), job=job)
    assert isinstance(made, Shout)
    return Shout(f"{seed} {made.text}")


@stage(version=1)
def evaluate(shout: Shout, params: ScoreParams, job: Job) -> Marks:
    """Give marks."""
    return Marks(shout.text)


STAGES: list[Stage] = [read, shout, export]
BENCH_STAGES: list[Stage] = [read, start, train, evaluate]
