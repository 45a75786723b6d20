"""The table of operations: whole, and chosen from by device."""

import inspect
from pathlib import Path

import pytest
import torch

from refdgs_pipe import ops
from refdgs_pipe.ops.registry import OPERATIONS, Kernel, backend_of, using


def arguments(kernel: Kernel) -> list[str]:
    function = kernel.forward if isinstance(kernel, type) else kernel
    return [name for name in inspect.signature(function).parameters if name != "ctx"]


def test_every_operation_is_the_kernel_of_a_public_function() -> None:
    assert set(OPERATIONS) <= set(ops.__all__)
    assert len(OPERATIONS) >= 12


@pytest.mark.parametrize("name", sorted(OPERATIONS))
def test_the_kernels_of_an_operation_take_the_same_arguments(name: str) -> None:
    operation = OPERATIONS[name]
    wanted = arguments(operation.definition)
    assert arguments(operation.cpu) == wanted
    assert arguments(operation.gpu) == wanted


def test_a_tensor_s_device_chooses_the_kernel_if_nothing_else_does() -> None:
    here = torch.zeros(1)
    assert backend_of(here) == "cpu"
    with using("definition"):
        assert backend_of(here) == "definition"
        with using("gpu"):
            assert backend_of(here) == "gpu"
        assert backend_of(here) == "definition"
    assert backend_of(here) == "cpu"


def test_only_one_module_takes_addresses() -> None:
    root = Path(ops.__file__).parents[1]
    found = {p.relative_to(root) for p in root.rglob("*.py") if "data_ptr" in p.read_text()}
    assert found == {Path("ops/addresses.py")}
