"""GPUs are handed out one to a job."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from refdgs_pipe.cli.batch.gpus import own_gpu
from refdgs_pipe.cli.gpus import visible_gpus

HOLD = (
    "import sys, pathlib\n"
    "from refdgs_pipe.cli.batch.gpus import own_gpu\n"
    "with own_gpu(['0', '1'], pathlib.Path(sys.argv[1])) as name:\n"
    "    print(name, flush=True)\n"
    "    sys.stdin.read()\n"
)


@pytest.fixture(autouse=True)
def _plain(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SLURM_JOB_ID", "KUBERNETES_SERVICE_HOST"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")


def held(folder: Path) -> subprocess.Popen[str]:
    """A process that holds a GPU."""
    return subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def name_of(process: subprocess.Popen[str]) -> str:
    """The GPU that it got."""
    assert process.stdout is not None
    return process.stdout.readline().strip()


def test_two_jobs_get_two_gpus_and_a_third_waits_until_one_is_killed(tmp_path: Path) -> None:
    first, second = held(tmp_path), held(tmp_path)
    names = {name_of(first): first, name_of(second): second}
    assert set(names) == {"0", "1"}
    third = held(tmp_path)
    assert third.poll() is None
    names["1"].kill()
    assert name_of(third) == "1"
    for process in (first, second, third):
        process.kill()
        process.communicate()


def test_a_job_sees_only_its_own_gpu(tmp_path: Path) -> None:
    with own_gpu(["1"], tmp_path) as name:
        assert name == "1" and os.environ["CUDA_VISIBLE_DEVICES"] == "1"


@pytest.mark.parametrize("scheduler", ["SLURM_JOB_ID", "KUBERNETES_SERVICE_HOST"])
def test_where_a_scheduler_hands_out_gpus_nothing_is_locked(
    tmp_path: Path, scheduler: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(scheduler, "1")
    with own_gpu(["0"], tmp_path) as name:
        assert name is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "names"),
    [("2, 3", ["2", "3"]), ("", []), ("-1", []), ("GPU-ab12,../x", ["GPU-ab12"])],
)
def test_the_gpus_are_those_that_cuda_may_see(
    text: str, names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", text)
    assert visible_gpus() == names
