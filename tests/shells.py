"""The command line over small stages, in a process of its own.

Most are forks of one that has loaded it, see `forking`.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from forking import Forked, Process

FAKE_CLI = Path(__file__).parent / "fake_cli.py"


class Shell:
    """Runs the command line in a folder with two letters."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.letters = root / "letters"
        self.letters.mkdir()
        (self.letters / "a.txt").write_text("hello")
        (self.letters / "b.txt").write_text("world")
        self.work = root / "letters.refdgs"
        self.command = [str(FAKE_CLI)]
        paths = os.pathsep.join(path for path in sys.path if path)
        self.environment = os.environ | {"PYTHONPATH": paths, "COLUMNS": "100"}

    def start(self, *arguments: str, **environment: str) -> Process:
        if "PYTHONPATH" not in environment:
            words = [*self.command, *arguments]
            return Forked(words, self.root, self.environment | environment)
        return subprocess.Popen(  # Python itself is to start in another way
            [sys.executable, str(FAKE_CLI), *arguments],
            cwd=self.root,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=self.environment | environment,
        )

    def __call__(
        self, *arguments: str, code: int = 0, **environment: str
    ) -> subprocess.CompletedProcess[str]:
        process = self.start(*arguments, **environment)
        out, err = process.communicate(timeout=60)
        assert process.returncode == code, out + err
        assert "Traceback" not in out + err
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def json(self, *arguments: str, code: int = 0, **environment: str) -> Any:
        return json.loads(self(*arguments, "--json", code=code, **environment).stdout)
