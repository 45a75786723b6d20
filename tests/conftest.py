"""Settings of the test run: threads that wait, and how many processes `-n auto` stands for."""

import os

import pytest

# Waiting threads sleep soon, as under the command line: the suite stays quick under load.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "20000")

MOST_WORKERS = 4  # each loads all libraries, about 1 GB


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Processes for `-n auto`. The tests of a file stay together: they share what they made."""
    if config.option.dist == "no":
        config.option.dist = "loadfile"
    return min(os.cpu_count() or 1, MOST_WORKERS)
