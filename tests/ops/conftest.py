"""One fixture for the backends of the operations."""

from collections.abc import Iterator

import pytest
from ops.backends import Backend, running


@pytest.fixture(params=["cpu", "emulated", "gpu"])
def kernels(request: pytest.FixtureRequest) -> Iterator[Backend]:
    """Every compiled backend; a test gives tensors by `here`."""
    with running(request.param) as backend:
        yield backend


@pytest.fixture(params=["definition", "cpu", "emulated"])
def backend(request: pytest.FixtureRequest) -> Iterator[Backend]:
    """Every backend that computes with doubles of the CPU."""
    with running(request.param) as backend:
        yield backend
