"""What a bench found, as bench.json for programs and bench.md for people."""

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from math import isfinite
from pathlib import Path
from statistics import fmean
from typing import Any

from refdgs_pipe.pipeline.atomic import disk_errors, write_json, write_text
from refdgs_pipe.pipeline.store import MANIFEST

JSON, TABLE = "bench.json", "bench.md"
TRAINED = ("start", "train", "shape", "refine")  # stages
TIMES = ("train_s", "total_s")


@dataclass(frozen=True)
class Row:
    """One cell of the grid.

    Args:
        recipe: its name; assignments: all settings given beside it.
        status: waiting, done, failed (with `reason`) or stopped.
        figures: every number that its scores hold.
        seconds: stage -> what it took, over all the calls that worked on it.
        stopped_s: key of a result -> seconds of the calls that were stopped while making it; its
            manifest knows only the last call, which went on from the checkpoint.
    """

    scene: str
    recipe: str
    seed: int
    workspace: str
    assignments: tuple[str, ...]
    status: str = "waiting"
    reason: str = ""
    exit_code: int = 0
    figures: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    stopped_s: dict[str, float] = field(default_factory=dict)

    @property
    def identity(self) -> tuple[str, tuple[str, ...]]:
        """What must be the same for an earlier row to be about this cell."""
        return self.workspace, self.assignments

    @property
    def total_s(self) -> float:
        """Seconds of all stages up to the scores."""
        return sum(self.seconds.values())

    @property
    def train_s(self) -> float | None:
        """Seconds of the stages of training; None if none is known."""
        known = [self.seconds[name] for name in TRAINED if name in self.seconds]
        return sum(known) if known else None

    @property
    def values(self) -> dict[str, float]:
        """Figures and times, if the cell is done."""
        if self.status != "done":
            return {}
        train = {} if self.train_s is None else {"train_s": self.train_s}
        return {**self.figures, **train, "total_s": self.total_s}


def figures_of(folder: Path) -> dict[str, float]:
    """Every number in the JSON of a result, by its place: "psnr", "surface.chamfer".

    What stands under "mean" needs no prefix. Lists are left out: they are about single views.
    """
    found: dict[str, float] = {}
    for path in sorted(folder.glob("*.json")):
        if path.name != MANIFEST:
            found |= _numbers(json.loads(path.read_text("utf-8")), "")
    return {name.removeprefix("mean."): number for name, number in found.items()}


def read_rows(out: Path) -> dict[tuple[str, tuple[str, ...]], Row]:
    """The rows of an earlier call by their identity; none if they cannot be read."""
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        rows = []
        for cell in json.loads((out / JSON).read_text("utf-8"))["cells"]:
            known = {key: cell[key] for key in Row.__dataclass_fields__}
            rows.append(Row(**{**known, "assignments": tuple(cell["assignments"])}))
        return {row.identity: row for row in rows}
    return {}


def write_tables(out: Path, rows: Sequence[Row]) -> None:
    """Replace bench.json and bench.md; readers see the old ones or the new ones.

    Raises:
        WriteError: the folder cannot be written.
    """
    with disk_errors(out):
        write_json(out / JSON, record(rows))
        write_text(out / TABLE, markdown(rows))


def record(rows: Iterable[Row]) -> dict[str, Any]:
    """All cells, their means over seeds, and these' means over scenes, for programs."""
    rows = _sorted(rows)
    cells = [asdict(row) | {"train_s": row.train_s, "total_s": row.total_s} for row in rows]
    return {"cells": cells, "scenes": over_seeds(rows), "recipes": over_scenes(rows)}


def over_seeds(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """For each scene and recipe the mean of the cells that are done."""
    means = []
    for scene, recipe in dict.fromkeys((row.scene, row.recipe) for row in rows):
        mine = [row for row in rows if (row.scene, row.recipe) == (scene, recipe)]
        done = [row.values for row in mine if row.values]
        head = {"scene": scene, "recipe": recipe, "done": len(done), "of": len(mine)}
        means.append(head | {"figures": _mean(done)})
    return means


def over_scenes(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """For each recipe the mean of its scenes' means; each scene counts once."""
    scenes = over_seeds(rows)
    means = []
    for recipe in dict.fromkeys(row.recipe for row in rows):
        mine = [scene for scene in scenes if scene["recipe"] == recipe]
        done = [scene["figures"] for scene in mine if scene["done"]]
        head = {"recipe": recipe, "done": len(done), "of": len(mine)}
        means.append(head | {"figures": _mean(done)})
    return means


def markdown(rows: Iterable[Row]) -> str:
    """The three tables."""
    rows = _sorted(rows)
    names = _columns([row.values for row in rows])
    cells = [
        [row.scene, row.recipe, str(row.seed), *_cells(row.values, names), _note(row)]
        for row in rows
    ]
    scenes = [
        [m["scene"], m["recipe"], f"{m['done']} of {m['of']}", *_cells(m["figures"], names)]
        for m in over_seeds(rows)
    ]
    recipes = [
        [m["recipe"], f"{m['done']} of {m['of']}", *_cells(m["figures"], names)]
        for m in over_scenes(rows)
    ]
    parts = [
        "# Bench",
        _table(["scene", "recipe", "seed", *names, "note"], cells),
        "## Means over seeds",
        _table(["scene", "recipe", "seeds", *names], scenes),
        "## Means over scenes",
        "Each scene counts once, by its mean over seeds. Compare only rows of as many scenes.",
        _table(["recipe", "scenes", *names], recipes),
    ]
    return "\n\n".join(parts) + "\n"


def _sorted(rows: Iterable[Row]) -> list[Row]:
    """By scene and recipe as given, then by seed."""
    rows = list(rows)
    scenes = list(dict.fromkeys(row.scene for row in rows))
    recipes = list(dict.fromkeys(row.recipe for row in rows))
    return sorted(rows, key=lambda r: (scenes.index(r.scene), recipes.index(r.recipe), r.seed))


def _numbers(value: Any, place: str) -> dict[str, float]:
    if isinstance(value, dict):
        inner = [_numbers(item, f"{place}.{key}" if place else key) for key, item in value.items()]
        return {key: number for part in inner for key, number in part.items()}
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return {place: value} if is_number else {}


def _mean(parts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Of each figure over those that have it."""
    return {name: fmean(part[name] for part in parts if name in part) for name in _columns(parts)}


def _columns(parts: Iterable[Mapping[str, float]]) -> list[str]:
    """Every figure's name, in the order of the scores, the times last."""
    names = dict.fromkeys(name for part in parts for name in part)
    return [name for name in names if name not in TIMES] + [n for n in TIMES if n in names]


def _cells(values: Mapping[str, float], names: Iterable[str]) -> list[str]:
    return [_figure(values[name]) if name in values else "" for name in names]


def _figure(value: float) -> str:
    """With the digits that matter, and never 1e+05."""
    if not isfinite(value):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 1000 or value == int(value) else f"{value:.4g}"


def _note(row: Row) -> str:
    if row.status == "done":
        return ""
    return " ".join(f"{row.status}: {row.reason}".split()).removesuffix(":").replace("|", "\\|")


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
