"""How the captures of a batch stand, from what their jobs left and from the workspaces' locks."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from refdgs_pipe.cli.activity import activity
from refdgs_pipe.cli.batch.parts import ENDS, Attempts, Result
from refdgs_pipe.cli.batch.table import Batch, Capture
from refdgs_pipe.formatting import aligned, counted, duration, printable

STATES = ("done", "running", "waiting", "to retry", "failed")


@dataclass(frozen=True)
class Standing:
    """How one capture stands.

    Args:
        state: one of STATES. "failed" cannot be mended by another attempt; "to retry" may be.
        part: the job that runs, comes next, or failed; the last one if all is done.
        reason: why it failed, or what it is doing.
        seconds: job -> how long it took.
        workspace, asset, report: relative to the batch; the latter None while they are not there.
    """

    capture: str
    photos: str
    state: str
    part: str
    reason: str = ""
    exit_code: int = 0
    verdict: str | None = None
    score: float | None = None
    warnings: int = 0
    attempts: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    workspace: str = ""
    asset: str | None = None
    report: str | None = None


def standing(batch: Batch, capture: Capture) -> Standing:
    """How a capture stands."""
    root = batch.workspace(capture)
    results = {part: Result.read(batch, capture.name, part) for part in ENDS}
    there = {part: result for part, result in results.items() if result}
    attempts = {part: Attempts.read(batch, capture.name, part) for part in ENDS}
    shared: dict[str, Any] = {
        "attempts": sum(found.count for found in attempts.values()),
        "seconds": {part: result.seconds for part, result in there.items()},
        "workspace": root.relative_to(batch.root).as_posix(),
        "report": next((r.report for r in reversed(there.values()) if r.report), None),
    }
    name, photos = capture.name, str(capture.photos)
    for part, result in there.items():
        if result.status == "failed":
            reason, code = result.message, result.exit_code
            return Standing(name, photos, "failed", part, reason, code, **shared)
    last = results[list(ENDS)[-1]]
    if last is not None and last.status == "done":
        verdict = last.verdict or {}
        shared |= {"verdict": verdict.get("word"), "score": verdict.get("score")}
        shared |= {"warnings": len(last.warnings), "asset": last.asset}
        return Standing(name, photos, "done", last.part, **shared)
    part = next(part for part in ENDS if part not in there)
    if now := activity(root):
        return Standing(name, photos, "running", part, now.words, **shared)
    tried = attempts[part]
    log = batch.root / "logs" / f"{name}.{part}.log"
    if tried.running or tried.exit_code or log.is_file():
        words = tried.message or f"killed, or could not start: {log.relative_to(batch.root)}"
        return Standing(name, photos, "to retry", part, words, tried.exit_code, **shared)
    return Standing(name, photos, "waiting", part, **shared)


def standings(batch: Batch) -> list[Standing]:
    """How every capture stands, in the order of the table."""
    return [standing(batch, capture) for capture in batch.captures]


def record(batch: Batch, found: Sequence[Standing]) -> dict[str, Any]:
    """As JSON has it."""
    return {
        "batch": str(batch.root),
        "cache": batch.cache,
        "counts": counts(found),
        "captures": [asdict(one) for one in found],
    }


def counts(found: Sequence[Standing]) -> dict[str, int]:
    """state -> how many captures."""
    number = Counter(one.state for one in found)
    return {state: number[state] for state in STATES}


def describe(found: Sequence[Standing], *, every: bool) -> list[str]:
    """In words: the counts, then what a person should look at.

    Args:
        every: every capture; else only those that run, failed or wait for another attempt.
    """
    shown = [f"{number} {state}" for state, number in counts(found).items() if number]
    lines = [f"{counted(len(found), 'capture')}: {', '.join(shown) or 'none'}"]
    rows = []
    for one in found:
        if every or one.state not in ("done", "waiting"):
            took = duration(sum(one.seconds.values())) if one.seconds else ""
            code = f" ({one.exit_code})" if one.exit_code else ""
            words = " ".join(one.reason.split())[:200] or (one.verdict or "")
            rows.append((one.capture, one.state, f"{one.part}{code}", took, words))
    return [*lines, *(printable(line) for line in aligned(rows, before="  "))]
