"""The three jobs of a capture, what each leaves behind, and whether that still holds."""

from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

from refdgs_pipe.cli.batch.table import Batch, Capture
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.documents import parse_json, read_text
from refdgs_pipe.errors import OutOfMemory, RefdgsError
from refdgs_pipe.pipeline.atomic import disk_errors, write_json

# job -> the last stage that it makes; None: all
ENDS: dict[str, str | None] = {"prepare": "masks", "train": "refine", "finish": None}
FOLDER = "steps"
PERMANENT = range(64, 71)  # exit codes of what another attempt cannot mend
_LIMIT = 1_000_000


@dataclass(frozen=True)
class Result:
    """What a job leaves when it is over for good. It is written last, in one step.

    Args:
        status: done; failed, where another attempt would fail too; skipped, after a failed job.
        asked: a hash of photos, settings and programs; another one makes this out of date.
        made: stage -> seconds, of what this job made.
        fetched: stages whose results came from the shared ones.
        verdict: word, line and score, of `finish`.
        asset, report: relative to the batch.
    """

    capture: str
    part: str
    status: str
    asked: str
    exit_code: int = 0
    kind: str = ""
    message: str = ""
    seconds: float = 0.0
    made: dict[str, float] = field(default_factory=dict)
    fetched: list[str] = field(default_factory=list)
    device: str = ""
    host: str = ""
    ended_utc: str = ""
    verdict: dict[str, Any] | None = None
    warnings: list[str] = field(default_factory=list)
    asset: str | None = None
    report: str | None = None

    @classmethod
    def read(cls, batch: Batch, name: str, part: str) -> Self | None:
        """The result of a job; None if there is none that can be read."""
        found = _record(result_path(batch, name, part))
        known = {key: found[key] for key in (f.name for f in fields(cls)) if key in found}
        with suppress(TypeError):
            result = cls(**known)
            if (result.capture, result.part) == (name, part) and result._is_sound():
                return result
        return None

    def write(self, batch: Batch) -> None:
        """Put it in its place.

        Raises:
            WriteError: it cannot be written.
        """
        path = result_path(batch, self.capture, self.part)
        with disk_errors(batch.root):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, asdict(self))

    def _is_sound(self) -> bool:
        kinds: dict[str, Any] = {
            **dict.fromkeys(("status", "asked", "message"), str),
            **dict.fromkeys(("asset", "report"), str | None),
            **{"exit_code": int, "seconds": int | float, "made": dict, "warnings": list},
        }
        if not all(isinstance(getattr(self, key), kind) for key, kind in kinds.items()):
            return False
        verdict = {"word": "", "score": 0.0} if self.verdict is None else self.verdict
        if not isinstance(verdict, dict) or not isinstance(verdict.get("word"), str):
            return False
        return isinstance(verdict.get("score"), int | float)


@dataclass(frozen=True)
class Attempts:
    """What is known of a job's attempts; the Snakefile asks it how much memory the next one needs.

    Args:
        memory: how many ended for lack of memory, or were killed without a word.
        running: one began and has not ended, or was killed.
    """

    count: int = 0
    memory: int = 0
    running: bool = False
    exit_code: int = 0
    message: str = ""

    @classmethod
    def read(cls, batch: Batch, name: str, part: str) -> Self:
        """The note of a job's attempts; an empty one where there is none."""
        found = _record(attempts_path(batch, name, part))
        with suppress(KeyError, TypeError, ValueError):
            numbers = [int(found[key]) for key in ("count", "memory", "exit_code")]
            message = str(found.get("message", ""))
            return cls(numbers[0], numbers[1], bool(found["running"]), numbers[2], message)
        return cls()

    def begun(self) -> "Attempts":
        """With another attempt."""
        return replace(
            self, count=self.count + 1, memory=self.memory + int(self.running), running=True
        )

    def ended(self, error: RefdgsError) -> "Attempts":
        """With the end of the attempt, for a reason that may pass."""
        short = int(error.exit_code == OutOfMemory.exit_code)
        return replace(
            self,
            memory=self.memory + short,
            running=False,
            exit_code=error.exit_code,
            message=str(error),
        )

    def write(self, batch: Batch, name: str, part: str) -> None:
        """Keep it. It only helps: a disk that cannot take it ends nothing."""
        path = attempts_path(batch, name, part)
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, asdict(self))


def result_path(batch: Batch, name: str, part: str) -> Path:
    """Where a job's result is: what Snakemake waits for."""
    return batch.root / FOLDER / name / f"{part}.json"


def attempts_path(batch: Batch, name: str, part: str) -> Path:
    """Where the note of a job's attempts is."""
    return batch.root / FOLDER / name / f"{part}.attempts.json"


def requests(space: Workspace) -> dict[str, str]:
    """job -> a hash of all that its result depends on; empty where that cannot be told."""
    try:
        mark = space.fingerprint()
        return {p: space.pipeline.request(end, mark, space.settings) for p, end in ENDS.items()}
    except (RefdgsError, OSError):
        return dict.fromkeys(ENDS, "")


def settle(batch: Batch, capture: Capture, *, retry_failed: bool = False) -> bool:
    """Whether all three jobs are over. Results that do not hold any more are deleted.

    The keys decide: a result holds as long as photos, settings and programs are those that it was
    made from, and the stages' own results are there.

    Args:
        retry_failed: what failed for good does not hold.
    """
    results = {part: Result.read(batch, capture.name, part) for part in ENDS}
    if not any(results.values()):
        return False
    asked, done = _standing(batch, capture)
    parts = list(ENDS)
    for i, part in enumerate(parts):
        result = results[part]
        holds = result is not None and result.asked == asked[part]
        if holds and result is not None:
            holds = part in done if result.status == "done" else not retry_failed
        if not holds:
            with disk_errors(batch.root):
                for later in parts[i:]:
                    result_path(batch, capture.name, later).unlink(missing_ok=True)
                    attempts_path(batch, capture.name, later).unlink(missing_ok=True)
            return False
    return True


def _standing(batch: Batch, capture: Capture) -> tuple[dict[str, str], set[str]]:
    """What each job's result would depend on now, and the jobs whose stages are all there."""
    try:
        space = batch.open(capture)
        mark = space.fingerprint()
        steps = space.pipeline.status(mark, space.settings)
    except (RefdgsError, OSError):
        return dict.fromkeys(ENDS, ""), set()
    there = {step.stage.name for step in steps if step.manifest}
    needed = {p: space.pipeline.needed_for(end) for p, end in ENDS.items()}
    asked = {p: space.pipeline.request(end, mark, space.settings) for p, end in ENDS.items()}
    return asked, {part for part in ENDS if {stage.name for stage in needed[part]} <= there}


def _record(path: Path) -> dict[str, Any]:
    try:
        found = parse_json(read_text(path, limit=_LIMIT))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
