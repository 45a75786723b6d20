"""Which device the work runs on, and with how much of its memory."""

import os
import re
from pathlib import Path

from refdgs_pipe.cli.gpus import mig_problem, show_only
from refdgs_pipe.errors import DeviceError, InputError

DEVICES = ("auto", "cpu", "cuda")
# what the driver shows on Linux, in containers that hide /proc, and on WSL (of any GPU)
DRIVER_SIGNS = ("/proc/driver/nvidia/version", "/dev/nvidiactl", "/dev/nvidia0", "/dev/dxg")
UNITS = {"MB": 10**6, "GB": 10**9, "MIB": 2**20, "GIB": 2**30}
REBUILD = "Reinstall where nvcc is on the PATH: pip install --force-reinstall --no-deps ."


def check_device(wanted: str) -> str:
    """The device asked for, if it can be used; "auto" always can.

    Raises:
        InputError, DeviceError: as `choose_device`.
    """
    return wanted if wanted == "auto" else choose_device(wanted)


def choose_device(wanted: str) -> str:
    """ "cpu" or "cuda". With "auto" a GPU is used if it is there and both libraries can use it.

    Args:
        wanted: auto, cpu, cuda, or cuda:N. N is a GPU's number in nvidia-smi, or its place in
            CUDA_VISIBLE_DEVICES if that is set. From then on, this process and those that it
            starts see no other GPU.

    Raises:
        InputError: there is no such kind of device.
        DeviceError: "cuda" was asked for and cannot be used.
    """
    kind, colon, index = wanted.partition(":")
    if kind not in DEVICES or (colon and (kind != "cuda" or not re.fullmatch(r"\d{1,4}", index))):
        raise InputError(f"--device {wanted}: expected {', '.join(DEVICES)} or cuda:N")
    if kind == "cpu" or (kind == "auto" and not has_driver()):
        return "cpu"
    if index and has_driver():
        show_only(int(index))
    problem = cuda_problem()
    if problem is None:
        return "cuda"
    if kind == "cuda":
        raise DeviceError(f"--device {wanted}: {problem}. Or use --device cpu")
    return "cpu"


def bytes_of(text: str) -> int:
    """An amount of memory such as 8GB or 600MB, in bytes; 0 for an empty text.

    Raises:
        InputError: it is no such amount.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?) *(MB|GB|MiB|GiB)", text.strip(), re.IGNORECASE)
    if not text:
        return 0
    if not found or not float(found[1]):
        raise InputError(f"--vram {text}: expected an amount such as 8GB")
    return int(float(found[1]) * UNITS[found[2].upper()])


def has_driver() -> bool:
    """Whether an NVIDIA driver runs on this machine, found out without loading anything."""
    return any(Path(sign).exists() for sign in DRIVER_SIGNS)


def cuda_problem() -> str | None:
    """The one mismatch that keeps CUDA from being used, then its fix; None if there is none."""
    if not has_driver():
        return "no NVIDIA driver is running. Install the driver of this machine's GPU"
    import torch

    made_for = torch.version.cuda
    if made_for is None:
        return (
            f"torch {torch.__version__} is a build for the CPU. Install one for CUDA: "
            "pip install torch --index-url https://download.pytorch.org/whl/cu130"
        )
    if not torch.cuda.is_available():
        return mig_problem() or (
            f"torch for CUDA {made_for} finds no GPU that the driver {driver_version()} lets it "
            "use. Update the driver, or install torch for an older CUDA"
        )
    import _refdgs_native

    if not _refdgs_native.cuda_archs:
        return f"the native module was built without CUDA. {REBUILD}"
    major, minor = torch.cuda.get_device_capability()
    if not runs_on(_refdgs_native.cuda_archs, major, minor):
        name = torch.cuda.get_device_name()
        return (
            f"the native module was built for {described(_refdgs_native.cuda_archs)}, but the "
            f"{name} is sm_{major}{minor}. Build for it: REFDGS_CUDA_ARCHS={major}{minor} "
            "pip install --force-reinstall --no-deps ."
        )
    if not _refdgs_native.cuda_device():
        return (
            f"the native module was built by a newer CUDA than the driver {driver_version()} can "
            f"run. Update the driver, or put nvcc of CUDA {made_for} on the PATH and run: "
            "pip install --force-reinstall --no-deps ."
        )
    return None


def driver_version() -> str:
    """The running NVIDIA driver's version, or "of unknown version"."""
    try:
        text = Path("/proc/driver/nvidia/version").read_text("utf-8", "replace")
    except OSError:
        text = ""
    found = re.search(r"\b(\d{3,}\.\d+(?:\.\d+)?)\b", text)
    return found[1] if found else "of unknown version"


def runs_on(archs: str, major: int, minor: int) -> bool:
    """Whether kernels for `archs` (CMake's names with commas between) run on a GPU.

    Compiled code runs on the same major version from its minor version on; PTX on anything newer.
    """
    for arch in archs.split(","):
        number, _, kind = arch.partition("-")
        made = divmod(int(re.sub(r"\D", "", number)), 10)
        if kind != "virtual" and made[0] == major and made[1] <= minor:
            return True
        if kind != "real" and made <= (major, minor):
            return True
    return False


def described(archs: str) -> str:
    """`archs` in words: sm_80 sm_90 and PTX."""
    names = archs.split(",")
    compiled = ["sm_" + n.removesuffix("-real") for n in names if not n.endswith("-virtual")]
    ptx = ["and PTX"] if any(not n.endswith("-real") for n in names) else []
    return " ".join(compiled + ptx)


def let_waiting_threads_sleep() -> None:
    """Choose how OpenMP threads wait, unless the user did; before a library that has them loads.

    Threads that wait by spinning make a busy machine several times slower; threads that sleep at
    once make a quiet one a third slower. 20 000 turns are some 50 microseconds.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("GOMP_SPINCOUNT", "20000")


def core_count() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
