"""The real command line over the small stages of `fake_stages`: python fake_cli.py run LETTERS

Workspaces whose names begin with `FAKE_EXCEPT`, if that is set, have the real stages.
"""

import os

from fake_stages import BENCH_STAGES, STAGES, Letters

from refdgs_pipe.cli import app
from refdgs_pipe.cli.batch import parts
from refdgs_pipe.pipeline import catalog
from refdgs_pipe.pipeline.plan import Pipeline
from refdgs_pipe.pipeline.stage import Stage
from refdgs_pipe.pipeline.store import Store

STANDS_FOR = {"masks": "read", "refine": "shout"}  # stages that end a job of a batch


class Small(Pipeline):
    """Of small stages, which are also found by the names of real ones."""

    def stage(self, name: str) -> Stage:
        return super().stage(STANDS_FOR.get(name, name))


def _mixed(prefix: str) -> None:
    """Real stages for workspaces whose names begin with the prefix, small ones for the others."""
    real = catalog.build

    def build(store: Store) -> Pipeline:
        return real(store) if store.root.name.startswith(prefix) else Small(Letters, STAGES, store)

    catalog.build = build


def _alone() -> None:
    """Small stages everywhere."""
    stages = BENCH_STAGES if "FAKE_BENCH" in os.environ else STAGES
    catalog.load_stages = lambda names=(): list(stages)
    catalog.source_type = lambda stages: Letters
    parts.ENDS.update(prepare="read", train="train" if "FAKE_BENCH" in os.environ else "shout")


if __name__ == "__main__":
    if prefix := os.environ.get("FAKE_EXCEPT"):
        _mixed(prefix)
    else:
        _alone()
    app.main()
