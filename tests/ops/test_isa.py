"""The kernels of lesser instruction sets, which this CPU would not choose."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

OPS = Path(__file__).parent


@pytest.mark.slow
@pytest.mark.parametrize("name", ["baseline", "avx2"])
def test_every_operation_passes_its_float_tests_with_every_instruction_set(name: str) -> None:
    environment = {**os.environ, "REFDGS_ISA": name}
    probe = [sys.executable, "-c", "from refdgs_pipe.ops.native import isa; print(isa())"]
    found = subprocess.run(probe, env=environment, capture_output=True, text=True, check=True)
    if found.stdout.strip() != name:
        pytest.skip(f"this CPU has no {name} kernels")
    files = [str(path) for path in sorted(OPS.glob("test_*.py")) if path.name != "test_isa.py"]
    chosen = [sys.executable, "-m", "pytest", "-q", "-k", "float or finite or threads", *files]
    result = subprocess.run(chosen, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout[-3000:]
