"""The last lines of a run: where the asset is, how large, what it is worth, what to do next."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from refdgs_pipe.artifacts.asset import Asset
from refdgs_pipe.cli.verdict import closing_lines, to_do
from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.errors import CorruptError
from refdgs_pipe.evaluation.verdict import Verdict
from refdgs_pipe.export.targets.names import FOLDER
from refdgs_pipe.formatting import aligned, counted, duration, merged, size
from refdgs_pipe.pipeline.plan import Step
from refdgs_pipe.reporting.dimensions import dimensions, is_size_known

FIRST = ("asset.glb", "asset.usdz", "asset.usdc", "asset.obj")  # what most people open


def closing(
    space: Workspace, record: dict[str, Any], steps: Sequence[Step], verdict: Verdict | None
) -> list[str]:
    """What came out, in words, for the end of a run.

    Args:
        record: as `run --json` prints it.
    """
    lines = ["", *_asset(record)]
    if warnings := merged(record["warnings"]):
        lines.append(f"{counted(len(warnings), 'warning')}: see above, or `status`")
    lines += closing_lines(verdict) if verdict else []
    if verdict and (steps_to_take := to_do(space, verdict)):
        lines += ["what to do next:", *(f"  {text}" for text in steps_to_take)]
    rows = [(name, duration(seconds)) for name, seconds in _made(record, steps)]
    if rows:
        rows.append(("report", duration(record["report_seconds"])))
        lines += [
            "time:",
            *aligned(rows, before="  "),
            f"finished in {duration(record['seconds'])}",
        ]
    else:
        lines.append("finished, everything was up to date")
    if record["report"]:
        lines.append(f"report: {record['report']}")
    return lines


def _made(record: dict[str, Any], steps: Sequence[Step]) -> list[tuple[str, float]]:
    """The stages that this run made, with their seconds."""
    took = {step.stage.name: step.manifest.seconds for step in steps if step.manifest}
    return [(name, took.get(name, 0.0)) for name in record["made"]]


def _asset(record: dict[str, Any]) -> list[str]:
    """Where the files are, and how large the object is."""
    if not record["asset"]:
        return []
    files: dict[str, int] = record["files"]
    named = [name for name in FIRST if name in files] or list(files)[:3]
    rows = [(name, size(files[name])) for name in named]
    made = f"{FOLDER}/"  # those are named one by one below
    rest = [n for name, n in files.items() if name not in named and not name.startswith(made)]
    if rest:
        rows.append((f"{len(rest)} more", size(sum(rest))))
    lines = [f"the asset is in {record['asset']}", *aligned(rows, before="  "), *_uses(record)]
    if record["size"] is None:
        return lines
    found = dimensions(Path(record["asset"]) / "asset.glb")
    sides = f"{found.words} (width x height x depth)" if found else record["size"]
    if is_size_known(record["size"]):
        return [*lines, f"its size is {sides}"]
    return [
        *lines,
        f"its real size is unknown; in the files it is {sides}",
        "  give its longest side: --size METRES; or print a mat for the photos: refdgs-pipe mat",
    ]


def _uses(record: dict[str, Any]) -> list[str]:
    """Which files were made for what."""
    try:
        targets = Asset.load(Path(record["asset"])).targets
    except CorruptError:
        return []
    files: dict[str, int] = record["files"]
    rows = []
    for made in targets:
        use, summary = made.name, made.summary
        if not made.files:
            rows.append((use, "", "", summary))
        for name in made.main_files:
            rows.append((use, name, size(files.get(name, 0)), summary))
            use = summary = ""
    return ["made for:", *aligned(rows, before="  ")] if rows else []
