"""What several tests of structure from motion look at."""

from pathlib import Path

import pytest
from captures import EXAMPLE, Stages

from refdgs_pipe.artifacts.sparse_model import SparseModel


@pytest.fixture(scope="session")
def placed(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], SparseModel]:
    """A dozen photos of the example, placed by themselves, with few features.

    They have 1,500 points; the first twelve of the example have 49.
    """
    photos = sorted(EXAMPLE.glob("*.jpg"))[-12:]
    stages = Stages(tmp_path_factory.mktemp("placed"))
    return photos, stages.sfm(stages.ingest(*photos), max_features=2500)
