"""The stages of the product, found by name: nothing imports a stage."""

from collections.abc import Sequence
from importlib import import_module

from refdgs_pipe.pipeline.leftovers import PUBLISHED
from refdgs_pipe.pipeline.plan import Pipeline
from refdgs_pipe.pipeline.stage import Source, Stage
from refdgs_pipe.pipeline.store import Store

__all__ = ["PUBLISHED", "STAGES", "build", "load_stages", "source_type"]

STAGES = (
    "ingest",
    "sfm",
    "gate",
    "lighting",
    "masks",
    "start",
    "train",
    "shape",
    "refine",
    "extract",
    "clean",
    "fit",
    "appearance",
    "unwrap",
    "bake",
    "export",
    "evaluate",
)


def load_stages(names: Sequence[str] = STAGES) -> list[Stage]:
    """The declared stages, in order."""
    found = []
    for name in names:
        stage = getattr(import_module(f"refdgs_pipe.stages.{name}"), name)
        assert isinstance(stage, Stage)
        found.append(stage)
    return found


def source_type(stages: Sequence[Stage]) -> type[Source]:
    """What the first stage takes, which no stage makes."""
    (source,) = stages[0].inputs.values()
    kind: type[Source] = source
    return kind


def build(store: Store) -> Pipeline:
    """The pipeline of the product over one workspace."""
    stages = load_stages()
    return Pipeline(source_type(stages), stages, store)
