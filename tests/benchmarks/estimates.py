"""How good were the estimates of finished runs? Replays the logs of workspaces.

    python tests/benchmarks/estimates.py --threads 2 WORKSPACE...

For each workspace, the last log of a run from the photos on. Its events are given to the forecast
and the estimate of `run`, at the times of the log. The machine counts as idle before, and no stage
as made before. The report is left out: logs do not have it.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refdgs_pipe.cli.console import Estimate
from refdgs_pipe.cli.forecast import REPORT, Forecast, forecast
from refdgs_pipe.cli.workspace import Workspace, open_workspace, remembered
from refdgs_pipe.formatting import duration
from refdgs_pipe.pipeline.events import Progress

EARLY = 0.1  # share of the run after which an estimate shall be right
LIMIT = 0.25  # by so much


@dataclass(frozen=True)
class Estimates:
    """A run, and what it was told to take in all: (share of the run, seconds)."""

    photos: int
    took_s: float
    told: list[tuple[float, float]]

    def first(self) -> float:
        return self.told[0][1] / self.took_s

    def after(self, share: float) -> float:
        """The first estimate after a share of the run, divided by what it took."""
        return next(s for at, s in self.told if at >= share) / self.took_s

    def worst(self) -> float:
        """The largest difference after EARLY, as a share of the whole run."""
        return max(abs(s / self.took_s - 1) for at, s in self.told if at >= EARLY)

    def kept(self) -> float:
        """The share of the estimates after EARLY that are within LIMIT."""
        good = [abs(s / self.took_s - 1) <= LIMIT for at, s in self.told if at >= EARLY]
        return sum(good) / len(good)


def whole_run(root: Path) -> list[dict[str, Any]] | None:
    """The events of the last run that made every stage; None if there is none."""
    for log in sorted((root / "logs").glob("*.jsonl"), reverse=True):
        events = [json.loads(line) for line in log.read_text().splitlines()]
        made = [e["stage"] for e in events if e["event"] == "finished"]
        if made[:1] == ["ingest"] and "evaluate" in made:
            return events
    return None


def replayed(space: Workspace, events: list[dict[str, Any]], cores: int) -> Estimates | None:
    """What `run` said during these events."""
    names = [e["stage"] for e in events if e["event"] == "finished"]
    if any(e["event"] in ("reused", "fetched") for e in events):
        return None
    begin = events[0]["time"]
    took = max(e["time"] for e in events if e["event"] == "finished") - begin
    plan: Forecast | None = None
    estimate, started, told = Estimate(), begin, []
    photos = next(int(e["value"]) for e in events if e.get("name") == "photos")
    for e in events:
        now = e["time"]
        if e["event"] == "started":
            started = now
            if plan is None and e["stage"] != names[0]:
                plan = forecast(space, [], names[1:], cores=cores)
                if plan is None:
                    return None
                plan.busy = 1.0
                plan.modelled.pop(REPORT)
                whole = now - begin + sum(plan.expect(name) for name in plan.modelled)
                told.append(((now - begin) / took, whole))
        elif e["event"] == "progress" and plan is not None:
            step = Progress(*(e[k] for k in ("stage", "label", "done", "total", "note", "work")))
            part = estimate.remaining_s(step, now)
            left = plan.left_s(step.stage, now - started, part, sure=step.work is not None)
            told.append(((now - begin) / took, now - begin + left))
        elif e["event"] == "finished" and plan is not None:
            plan.finished(e["stage"], e["seconds"])
    return Estimates(photos, took, told)


def rows(roots: list[Path], cores: int) -> Iterator[str]:
    """A table for people."""
    yield "| run | photos | took | first estimate | at 10 % | within 25 % after that | worst |"
    yield "|---|---:|---:|---:|---:|---:|---:|"
    for root in roots:
        events = whole_run(root)
        if events is None:
            continue
        space = open_workspace(root, remembered(root, None, ()))
        found = replayed(space, events, cores)
        if found is None:
            continue
        recipe = Path(space.memory.recipe).stem
        yield (
            f"| {root.name}, {recipe} | {found.photos} | {duration(found.took_s)} "
            f"| {found.first():.2f} | {found.after(EARLY):.2f} | {found.kept():.0%} "
            f"| {found.worst():.0%} |"
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("workspaces", nargs="+", type=Path)
    parser.add_argument("--threads", type=int, default=2, help="threads that the runs used")
    wanted = parser.parse_args()
    for row in rows(wanted.workspaces, wanted.threads):
        print(row, flush=True)


if __name__ == "__main__":
    main()
