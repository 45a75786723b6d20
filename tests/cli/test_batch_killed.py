"""A batch whose jobs are killed at random, over the real engine, command line, locks and cache.

python -m pytest -m slow -s tests/cli/test_batch_killed.py      100 captures, and 8 real ones
REFDGS_BATCH=1000 python -m pytest -m slow -s ...               1000; about an hour on two cores

Stand-ins of some milliseconds replace the stages of most captures. The real captures are tiny, and
have all stages of the product.
"""

import os
import random
import shlex
import shutil
import signal
import threading
import time
from collections import Counter
from pathlib import Path

import pytest
from batches import BatchShell, needs_snakemake
from test_end_to_end import FILES, sets, write_capture

from refdgs_pipe.pipeline.catalog import STAGES

pytest.importorskip("obstore", reason="obstore is not installed: the extra batch")
pytestmark = needs_snakemake
MANY = int(os.environ.get("REFDGS_BATCH", "100"))
# every so many captures: an unusable one, a mistake of ours, one that no setting of it can make
BAD, BUG, MUTE = 10, 25, 12
REAL = "real"  # their names begin so
SMALL = shlex.join(sets({})[1::2])  # as the table has settings


class Killer(threading.Thread):
    """Kills one of the jobs that run, every now and then, without a word.

    Not the only one: it would be hit each time, and would never end if it takes longer than that.
    """

    def __init__(self, batch: Path, every_s: float) -> None:
        super().__init__(daemon=True)
        self.batch, self.every_s, self.kills = str(batch), every_s, 0
        self.over = threading.Event()
        self._random = random.Random(1)

    def run(self) -> None:
        while not self.over.wait(self.every_s * self._random.uniform(0.5, 1.5)):
            if len(found := self._jobs()) > 1:
                try:
                    os.kill(self._random.choice(found), signal.SIGKILL)
                    self.kills += 1
                except ProcessLookupError:
                    continue

    def _jobs(self) -> list[int]:
        found = []
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                words = path.read_bytes().decode("utf-8", "replace").split("\0")
            except OSError:
                continue
            if "python" in words[0] and "step" in words and self.batch in words:
                found.append(int(path.parent.name))
        return found


def fill(shell: BatchShell, count: int, real: int) -> dict[str, str]:
    """A batch of that many captures and some real ones among them, and how each must end."""
    texts = {f"c{i:04}": f"hello {i}" for i in range(count)}
    wanted = dict.fromkeys(texts, "done")
    for i, name in enumerate(texts):
        if i % BAD == 3:
            texts[name], wanted[name] = "unusable", "failed 65"
        elif i % BUG == 11:
            texts[name], wanted[name] = "bug", "failed 70"
        elif i % MUTE == 7:
            wanted[name] = "failed 68"
    found = shell.captures(**texts)
    for i in range(real):  # no two alike: each is computed
        name = write_capture(shell.root / f"{REAL}{i}", count=16, size=56 + 2 * i).name
        found.insert(count * (i + 1) // (real + 1) + i, name)
        wanted[name] = "done"
    shell.begin(found, "--cache", "share")
    table = shell.batch / "captures.tsv"
    lines = table.read_text().splitlines()
    mute = {name for name, end in wanted.items() if end == "failed 68"}
    table.write_text(
        "\n".join(
            x + "shout.mood=mute" * (x.split("\t")[0] in mute) + SMALL * x.startswith(REAL)
            for x in lines
        )
        + "\n"
    )
    return wanted


def ends(shell: BatchShell) -> dict[str, str]:
    """How each capture ended."""
    found = shell.json("batch", "status", "B")["captures"]
    return {one["capture"]: f"{one['state']} {one['exit_code'] or ''}".strip() for one in found}


def run_to_the_end(shell: BatchShell, every_s: float) -> tuple[int, int]:
    """Run the batch, with jobs killed, until nothing is left to retry. Runs, and kills."""
    killer = Killer(shell.batch, every_s)
    killer.start()
    runs = 0
    while runs < 12:
        runs += 1
        process = shell.start(
            "batch", "run", "B", "--cores", "2", FAKE_ALONE="1", FAKE_STEP_S="0.01"
        )
        _, said = process.communicate(timeout=7200)
        assert "Traceback" not in said, said[-3000:]
        if set(shell.states().values()) <= {"done", "failed"}:
            break
    killer.over.set()
    killer.join()
    return runs, killer.kills


def check_results(shell: BatchShell, name: str) -> None:
    """A finished capture has every result once, and the asset that belongs to it."""
    made = Counter(path.parts[-3] for path in shell.made() if f"{name}.refdgs" in str(path))
    asset = shell.workspace(name) / "asset"
    if name.startswith(REAL):
        assert made == dict.fromkeys(STAGES, 1)
        assert {path.name for path in asset.iterdir()} >= FILES
        assert (asset / "asset.glb").read_bytes()[:4] == b"glTF"
    else:
        assert made == {"read": 1, "shout": 1, "export": 1}
        i = int(name[1:])
        assert (asset / "text").read_text() == f"HELLO {i}! (hello {i}) 20.0"


@pytest.mark.parametrize(("count", "real"), [(4, 0), pytest.param(MANY, 8, marks=pytest.mark.slow)])
@pytest.mark.timeout(15_000)
def test_every_capture_ends_once_in_the_right_state_though_jobs_are_killed(
    tmp_path: Path, count: int, real: int
) -> None:
    shell = BatchShell(tmp_path)
    if real:
        shell.environment["FAKE_EXCEPT"] = REAL
    wanted = fill(shell, count, real)
    every = len(wanted)
    start = time.monotonic()
    runs, kills = run_to_the_end(shell, every_s=5.0 if real else 3.0)
    took = time.monotonic() - start
    assert ends(shell) == wanted
    for name, end in wanted.items():
        if end == "done":
            check_results(shell, name)
    said = shell("cache", "verify", "share").stderr
    made = shell.made()
    start = time.monotonic()
    again = shell.start("batch", "run", "B", "--cores", "2").communicate(timeout=600)[1]
    second = time.monotonic() - start
    assert f"{every} of {every} captures are up to date" in again and shell.made() == made
    print(f"\n{every} captures, {kills} kills, {runs} runs: {took:.1f} s; again {second:.1f} s")
    print(dict(Counter(ends(shell).values())), said)
    shutil.rmtree(shell.batch / "workspaces")
    shutil.rmtree(shell.batch / "steps")
    process = shell.start("batch", "run", "B", "--cores", "2")
    process.communicate(timeout=7200)
    assert ends(shell) == wanted
    done = [name for name, end in wanted.items() if end == "done"]
    parts = [shell.result(n, p) for n in done for p in ("prepare", "train", "finish")]
    assert all(part["made"] == {} for part in parts)  # all of it came from the shared results
