"""What the tests of training share."""

from collections.abc import Iterator

import pytest

from refdgs_pipe.training import initial


@pytest.fixture(scope="module")
def coarse_start() -> Iterator[None]:
    """Trainings start from a hull in a third of the cells along each side.

    In the usual 96 the start takes ten times as long as a short training. Photos of at most 64
    pixels show no more than 32.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initial, "HULL_CELLS", 32)
        yield
