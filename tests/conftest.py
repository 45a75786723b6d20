"""Settings of the test run: threads that wait, and how many processes `-n auto` stands for."""

import os
import signal

import pytest

# Waiting threads sleep soon, as under the command line: the suite stays quick under load.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "20000")

# Programs that a shell starts in the background ignore Ctrl-C, and so would those of the tests.
signal.signal(signal.SIGINT, signal.default_int_handler)

MOST_WORKERS = 4  # each loads all libraries, about 1 GB
# Files of few tests that take long. They go first, so that no process is left with one at the end.
LONG = (
    "test_end_to_end.py",
    "test_python.py",
    "test_reconstruct.py",
    "test_masking.py",
    "test_carving.py",
    "test_gpu_checks.py",
    "test_register.py",
    "test_training_stages.py",
    "test_seams.py",
    "test_failures.py",
    "test_recorded.py",
    "test_mesh_stages.py",
    "test_batch_killed.py",
)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Processes for `-n auto`. The tests of a file stay together: they share what they made."""
    if config.option.dist == "no":
        config.option.dist = "loadfile"
        config.option.loadscopereorder = False
    return min(os.cpu_count() or 1, MOST_WORKERS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first; the rest as it was collected."""
    rank = {name: place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: rank.get(item.path.name, len(LONG)))
