"""Batches of small captures, whose stages take milliseconds, over the real command line."""

import json
import shlex
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import forking
import pytest
from shells import FAKE_CLI, Shell

needs_snakemake = pytest.mark.skipif(
    find_spec("snakemake") is None,
    reason="Snakemake is not installed: install the extra batch",
)


class BatchShell(Shell):
    """Makes captures, a batch of them, and looks at what came out.

    Args:
        forks: jobs are forks, see `forking`; else each starts Python, as those of a user do.
    """

    def __init__(self, root: Path, *, forks: bool = False) -> None:
        super().__init__(root)
        self.batch = root / "B"
        self.job = forking.command(FAKE_CLI) if forks else [sys.executable, str(FAKE_CLI)]

    def captures(self, **texts: str) -> list[str]:
        """A folder for each name, with one letter of that text."""
        for name, text in texts.items():
            (self.root / name).mkdir(exist_ok=True)
            (self.root / name / "a.txt").write_text(text)
        return list(texts)

    def init(self, *arguments: str, **texts: str) -> None:
        """A batch of these captures, whose jobs use the small stages."""
        self.begin(self.captures(**texts), *arguments)

    def begin(self, captures: Sequence[str], *arguments: str) -> None:
        """A batch of folders that are there, whose jobs use the command line of the tests."""
        self("batch", "init", *captures, *arguments, "--out", "B")
        path = self.batch / "Snakefile"
        lines = path.read_text().splitlines()
        at = next(i for i, line in enumerate(lines) if line.startswith("COMMAND ="))
        lines[at] = f"COMMAND = {shlex.join(self.job)!r}"
        at = next(i for i, line in enumerate(lines) if line.startswith("THREADS ="))
        lines[at] = 'THREADS = {"prepare": 1, "train": 1, "finish": 1}'
        path.write_text("\n".join(lines) + "\n")

    def step(self, name: str, part: str, code: int = 0, **environment: str) -> str:
        """One job; what it says."""
        return self("batch", "step", "B", name, part, code=code, **environment).stderr

    def result(self, name: str, part: str = "finish") -> Any:
        """What a job left."""
        return json.loads((self.batch / "steps" / name / f"{part}.json").read_text())

    def states(self) -> dict[str, str]:
        """capture -> how it stands."""
        found = self.json("batch", "status", "B")["captures"]
        return {one["capture"]: one["state"] for one in found}

    def made(self) -> dict[Path, int]:
        """When each stage's result was written."""
        found = self.batch.glob("workspaces/*/*/*/manifest.json")
        return {path: path.stat().st_mtime_ns for path in found}

    def workspace(self, name: str) -> Path:
        """A capture's workspace."""
        return self.batch / "workspaces" / f"{name}.refdgs"
