"""Laws of the doctor and of choosing a device."""

import importlib.util

import pytest

from refdgs_pipe.cli import device, doctor
from refdgs_pipe.errors import DeviceError, InputError


def test_the_native_module_is_described_or_a_fix_is_given() -> None:
    finding = doctor._native()
    if importlib.util.find_spec("_refdgs_native"):
        assert finding.ok and "instructions" in finding.text
    else:
        assert not finding.ok and "g++" in finding.fix


def test_a_missing_library_has_one_fix() -> None:
    finding = doctor._library("no_such_module", "no-such-distribution", "libnone")
    assert (finding.ok, finding.text) == (False, "not installed")
    assert finding.fix == "pip install no-such-distribution"


def test_a_library_that_cannot_be_loaded_names_its_system_packages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(target: str, arguments: object, **options: object) -> None:
        raise ImportError("libGL.so.1: cannot open shared object file\nmore")

    monkeypatch.setattr(doctor, "call_in_child", refuse)
    finding = doctor._library("open3d", "open3d-cpu", "libgl1")
    assert finding.text == "libGL.so.1: cannot open shared object file"
    assert finding.fix == "apt-get install libgl1"


def test_without_a_driver_auto_is_the_cpu_and_cuda_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(device, "has_driver", lambda: False)
    assert device.choose_device("auto") == "cpu"
    with pytest.raises(DeviceError, match="no NVIDIA driver is running"):
        device.choose_device("cuda")
    with pytest.raises(InputError, match="expected auto, cpu, cuda"):
        device.choose_device("tpu")
