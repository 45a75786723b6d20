"""What must be installed: Python libraries, and the system's shared libraries that they load."""

import ctypes
import sys
from collections.abc import Iterable
from importlib import import_module

from refdgs_pipe.child_process import call_in_child
from refdgs_pipe.errors import DeviceError, RefdgsError

LIBRARIES = {  # module -> distribution
    "torch": "torch",
    "cv2": "opencv-contrib-python-headless",
    "PIL": "pillow",
    "rawpy": "rawpy",
    "exifread": "exifread",
    "scipy": "scipy",
    "pycolmap": "pycolmap",
    "open3d": "open3d-cpu",
    "pymeshlab": "pymeshlab",
    "xatlas": "xatlas",
    "pxr": "usd-core",
    "safetensors": "safetensors",
}
SYSTEM = {  # module -> shared libraries of the system, and Debian's packages that have them
    "rawpy": {"libgomp.so.1": "libgomp1"},
    "pycolmap": {"libgomp.so.1": "libgomp1"},
    "open3d": {
        "libGL.so.1": "libgl1",
        "libEGL.so.1": "libegl1",
        "libX11.so.6": "libx11-6",
        "libusb-1.0.so.0": "libusb-1.0-0",
        "libgomp.so.1": "libgomp1",
    },
    "pymeshlab": {"libGL.so.1": "libgl1", "libOpenGL.so.0": "libopengl0"},
}
_TIMEOUT_S = 120


def packages_for(module: str) -> str:
    """Debian's packages with what a library loads from the system; "" if it loads nothing."""
    return " ".join(SYSTEM.get(module, {}).values())


def load(module: str) -> str:
    """Import a module and return where it is; runs in a child process."""
    return str(import_module(module).__file__)


def try_to_load(module: str) -> None:
    """Import a library in a process of its own: some abort.

    Raises:
        RefdgsError, ImportError, OSError, RuntimeError, AttributeError: it cannot be loaded.
    """
    call_in_child("refdgs_pipe.cli.libraries:load", {"module": module}, timeout_s=_TIMEOUT_S)


def require(distributions: Iterable[str]) -> None:
    """Refuse a run, before its first stage, if a library that it needs cannot be loaded.

    Takes milliseconds if the system's libraries are there. If one is not found, the library itself
    is tried, because it may bring its own.

    Raises:
        DeviceError: a library lacks what it needs of the system.
    """
    if sys.platform != "linux":
        return
    wanted = set(distributions)
    for module, distribution in LIBRARIES.items():
        needed = SYSTEM.get(module, {}) if distribution in wanted else {}
        missing = [name for name in needed if not _is_there(name)]
        if not missing:
            continue
        try:
            try_to_load(module)
        except (RefdgsError, ImportError, OSError, RuntimeError, AttributeError) as error:
            packages = " ".join(needed[name] for name in missing)
            raise DeviceError(
                f"{distribution} cannot be loaded, because this machine lacks "
                f"{', '.join(missing)}. Install what is missing (on Debian and Ubuntu: "
                f"apt-get install {packages}), then run this again"
            ) from error


def _is_there(name: str) -> bool:
    """Whether the system's loader finds a shared library."""
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True
