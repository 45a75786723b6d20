"""Laws of the doctor and of choosing a device."""

import importlib
import importlib.util
import os
from pathlib import Path

import pytest

from refdgs_pipe.cli import device, doctor, gpus, libraries
from refdgs_pipe.errors import DeviceError, InputError


def test_the_native_module_is_described_or_a_fix_is_given() -> None:
    finding = doctor._native()
    if importlib.util.find_spec("_refdgs_native"):
        assert finding.ok and "instructions" in finding.text
    else:
        assert not finding.ok and "g++" in finding.fix


def test_a_missing_library_has_one_fix() -> None:
    finding = doctor._library("no_such_module", "no-such-distribution")
    assert (finding.ok, finding.text) == (False, "not installed")
    assert finding.fix == "pip install no-such-distribution"


def test_a_library_that_cannot_be_loaded_names_its_system_packages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(target: str, arguments: object, **options: object) -> None:
        raise ImportError("libGL.so.1: cannot open shared object file\nmore")

    monkeypatch.setattr(libraries, "call_in_child", refuse)
    finding = doctor._library("pymeshlab", "pymeshlab")
    assert finding.text == "libGL.so.1: cannot open shared object file"
    assert finding.fix == "apt-get install libgl1 libopengl0"


def test_a_run_without_what_a_later_stage_needs_of_the_system_does_not_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(target: str, arguments: object, **options: object) -> None:
        raise ImportError("libnone.so.1: cannot open shared object file")

    monkeypatch.setattr(libraries.sys, "platform", "linux")
    monkeypatch.setattr(libraries, "call_in_child", refuse)
    monkeypatch.setattr(libraries, "SYSTEM", {"open3d": {"libnone.so.1": "libnone1"}})
    libraries.require(["pymeshlab", "scipy"])
    with pytest.raises(DeviceError, match=r"open3d-cpu cannot .* lacks libnone\.so\.1"):
        libraries.require(["scipy", "open3d-cpu"])


def test_a_library_that_brings_what_the_system_lacks_is_fine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried = []

    def load(target: str, arguments: dict[str, str], **options: object) -> str:
        tried.append(arguments["module"])
        return "here"

    monkeypatch.setattr(libraries.sys, "platform", "linux")
    monkeypatch.setattr(libraries, "call_in_child", load)
    monkeypatch.setattr(libraries, "SYSTEM", {"rawpy": {"libnone.so.1": "libnone1"}})
    libraries.require(["rawpy"])
    assert tried == ["rawpy"]


def test_the_set_up_script_installs_what_libraries_need_of_the_system() -> None:
    script = (Path(__file__).parents[2] / "examples" / "setup.sh").read_text("utf-8")
    pairs = {
        f"{name}={package}"
        for needs in libraries.SYSTEM.values()
        for name, package in needs.items()
    }
    assert {pair for pair in pairs if pair not in script} == set()


def test_a_library_that_only_one_option_needs_may_be_missing() -> None:
    finding = doctor._optional("no_such_module", "mask-model", "--mask-model")
    assert finding.ok
    assert finding.text.startswith("not installed; only --mask-model needs it: pip install ")


def test_without_a_driver_auto_is_the_cpu_and_cuda_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(device, "has_driver", lambda: False)
    assert device.choose_device("auto") == "cpu"
    with pytest.raises(DeviceError, match="no NVIDIA driver is running"):
        device.choose_device("cuda")
    with pytest.raises(InputError, match="expected auto, cpu, cuda"):
        device.choose_device("tpu")


def test_a_driver_alone_does_not_make_a_gpu_usable(monkeypatch: pytest.MonkeyPatch) -> None:
    """One mismatch at a time, each with its fix."""
    import torch

    native = importlib.import_module("_refdgs_native")
    monkeypatch.setattr(device, "has_driver", lambda: True)
    monkeypatch.setattr(device, "driver_version", lambda: "470.82")
    monkeypatch.setattr(torch.version, "cuda", None)
    assert "is a build for the CPU. Install one for CUDA" in str(device.cuda_problem())
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "the driver 470.82 lets it use. Update the driver" in str(device.cuda_problem())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(native, "cuda_archs", "")
    assert "built without CUDA. Reinstall where nvcc" in str(device.cuda_problem())
    monkeypatch.setattr(native, "cuda_archs", "90-real")
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (8, 6))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "RTX 3090")
    problem = str(device.cuda_problem())
    assert "built for sm_90, but the RTX 3090 is sm_86. Build for it" in problem
    assert "REFDGS_CUDA_ARCHS=86" in problem
    assert device.choose_device("auto") == "cpu"
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(native, "cuda_device", lambda: "")
    assert "newer CUDA than the driver 470.82 can run" in str(device.cuda_problem())
    monkeypatch.setattr(native, "cuda_device", lambda: "NVIDIA H200")
    assert device.cuda_problem() is None and device.choose_device("auto") == "cuda"


@pytest.mark.parametrize(
    ("modes", "listed", "told"),
    [
        ("Enabled\nDisabled\n", "", None),
        ("[N/A]\n", "", None),
        ("Enabled\n", "GPU 0: NVIDIA A100 (UUID: GPU-1)", "has no part. Make one"),
        (
            "Enabled\n",
            "GPU 0: A100 (UUID: GPU-1)\n  MIG 1g.10gb Device 0: (UUID: MIG-ab-12)",
            "no part is chosen. Choose one: CUDA_VISIBLE_DEVICES=MIG-ab-12",
        ),
    ],
)
def test_a_divided_gpu_is_explained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, modes: str, listed: str, told: str | None
) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text(f"#!/bin/sh\n[ \"$1\" = -L ] && echo '{listed}' || printf '{modes}'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    found = gpus.mig_problem()
    assert found is None if told is None else told in str(found)
    program.write_text("#!/bin/sh\nexit 9\n")
    assert gpus.mig_problem() is None


def test_one_gpu_of_several_is_chosen_by_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "has_driver", lambda: True)
    monkeypatch.setattr(device, "cuda_problem", lambda: None)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,6")
    monkeypatch.setenv("CUDA_DEVICE_ORDER", "PCI_BUS_ID")
    gpus.show_only.cache_clear()
    for wrong in ("cuda:", "cuda:x", "cuda:-1", "cpu:0", "auto:1"):
        with pytest.raises(InputError, match=f"--device {wrong}: expected auto, cpu, cuda or"):
            device.choose_device(wrong)
    with pytest.raises(DeviceError, match=r"sees 2 GPUs, cuda:0 to cuda:1\. Choose"):
        device.choose_device("cuda:2")
    assert device.choose_device("cuda:1") == "cuda" and os.environ["CUDA_VISIBLE_DEVICES"] == "6"
    assert device.choose_device("cuda:1") == "cuda" and os.environ["CUDA_VISIBLE_DEVICES"] == "6"
    with pytest.raises(DeviceError, match=r"sees one GPU, cuda:0\. Choose"):
        device.choose_device("cuda:3")
    gpus.show_only.cache_clear()


def test_little_free_memory_of_a_gpu_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(doctor, "has_driver", lambda: True)
    monkeypatch.setattr(doctor, "cuda_problem", lambda: None)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (10**9, 24 * 10**9))
    found = doctor._gpu()
    assert found.ok and "of 24" in found.text and found.fix.startswith("Stop other programs")

    def full() -> None:
        raise RuntimeError("CUDA error: out of memory\nmore")

    monkeypatch.setattr(torch.cuda, "mem_get_info", full)
    found = doctor._gpu()
    assert found.ok and "unknown: CUDA error: out of memory" in found.text


def test_compiled_code_runs_within_its_generation_and_ptx_on_newer_ones() -> None:
    assert device.runs_on("80-real,120-virtual", 8, 6)
    assert not device.runs_on("86-real", 8, 0)
    assert not device.runs_on("80-real,90-real", 10, 0)
    assert device.runs_on("80-real,90", 10, 0)
    assert device.runs_on("80-real,120-virtual", 12, 1)
    assert not device.runs_on("90-virtual", 8, 9)
    assert device.described("80-real,90,120-virtual") == "sm_80 sm_90 and PTX"


def test_amounts_of_memory_are_read() -> None:
    assert device.bytes_of("8GB") == 8 * 10**9
    assert device.bytes_of("1.5 gib") == 3 * 2**29
    assert device.bytes_of("") == 0
    for wrong in ("8", "GB", "0GB", "-1GB", "8TBx"):
        with pytest.raises(InputError, match="expected an amount such as 8GB"):
            device.bytes_of(wrong)
