"""What is installed, what it can do, and one fix for each problem."""

import os
import platform
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import typer

from refdgs_pipe import __version__
from refdgs_pipe.child_process import call_in_child
from refdgs_pipe.cli.device import core_count, cuda_problem, described, has_driver
from refdgs_pipe.cli.gpus import LEAST_FREE
from refdgs_pipe.cli.libraries import LIBRARIES, packages_for, try_to_load
from refdgs_pipe.cli.options import Json
from refdgs_pipe.documents import write_json_text
from refdgs_pipe.errors import RefdgsError
from refdgs_pipe.formatting import aligned, size

OPTIONAL = {  # module -> (extra, what needs it)
    "onnxruntime": ("mask-model", "--mask-model"),
    "snakemake": ("batch", "batch run"),
    "obstore": ("batch", "--cache"),
    "viser": ("view", "view"),
}
ENOUGH_DISK = 5_000_000_000
ENOUGH_MEMORY = 4_000_000_000


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at; `fix` says what to do if it is not ok."""

    name: str
    ok: bool
    text: str
    fix: str = ""


def doctor_command(as_json: Json = False) -> None:
    """Check this machine and the installation. Each problem has a fix."""
    findings = examine()
    print(write_json_text(record(findings), indent=2) if as_json else describe(findings))
    raise typer.Exit(0 if all(finding.ok for finding in findings) else 71)


def examine() -> list[Finding]:
    """Look at everything. Libraries are loaded in processes of their own: some abort."""
    findings = [_python(), _native()]
    findings += [_library(module, name) for module, name in LIBRARIES.items()]
    findings += [_optional(module, *entry) for module, entry in OPTIONAL.items()]
    return [*findings, _gpu(), _cores(), _memory(), _disk()]


def record(findings: Sequence[Finding]) -> dict[str, Any]:
    """As JSON has it."""
    is_ok = all(finding.ok for finding in findings)
    return {"ok": is_ok, "findings": [asdict(finding) for finding in findings]}


def describe(findings: Sequence[Finding]) -> str:
    """A line for each finding, and below it how to mend it."""
    rows = [("ok" if found.ok else "BAD", found.name, found.text) for found in findings]
    indent = " " * (aligned([(*row[:2], "|") for row in rows])[0].index("|"))
    lines = []
    for line, found in zip(aligned(rows), findings, strict=True):
        lines += [line, f"{indent}{found.fix}"] if found.fix else [line]
    return "\n".join(lines)


def native_facts() -> dict[str, str]:
    """What the native module was built with; runs in a child process."""
    import torch  # noqa: F401 (its OpenMP runtime must be the one in use)

    native = import_module("_refdgs_native")
    archs = native.cuda_archs
    facts = {"instructions": native.isa(), "openmp": str(native.openmp), "cuda:": "not built"}
    if archs:
        device = native.cuda_device() or "no device"
        facts["cuda:"] = f"built, {device} ({described(archs)})"
    return facts


def _python() -> Finding:
    ok = sys.version_info >= (3, 11)
    text = f"{platform.python_version()}, refdgs-pipe {__version__}, {platform.platform()}"
    return Finding("python", ok, text, "" if ok else "Use Python 3.11 or newer")


def _native() -> Finding:
    try:
        facts = call_in_child("refdgs_pipe.cli.doctor:native_facts", {}, timeout_s=120)
    except (RefdgsError, ImportError, RuntimeError, AttributeError) as error:
        fix = "Install a C++ compiler (apt-get install g++ python3-dev), then: pip install ."
        return Finding("native module", False, _first_line(error), fix)
    return Finding("native module", True, ", ".join(f"{k} {v}" for k, v in facts.items()))


def _library(module: str, distribution: str) -> Finding:
    try:
        try_to_load(module)
    except ModuleNotFoundError:
        return Finding(module, False, "not installed", f"pip install {distribution}")
    except (RefdgsError, ImportError, OSError, RuntimeError, AttributeError) as error:
        packages = packages_for(module)
        system = f"apt-get install {packages}" if packages else ""
        fix = system or f"pip install --force-reinstall {distribution}"
        return Finding(module, False, _first_line(error), fix)
    return Finding(module, True, _version(distribution))


def _optional(module: str, extra: str, user: str) -> Finding:
    """A library that only one option needs: it may be missing, but not broken."""
    found = _library(module, module)
    if found.ok or found.text != "not installed":
        return found
    fix = f"pip install {module} (the extra {extra})"
    return Finding(module, True, f"not installed; only {user} needs it: {fix}")


def _gpu() -> Finding:
    if not has_driver():
        return Finding("GPU", True, "none; everything runs on the CPU")
    try:
        problem = cuda_problem()
    except ImportError as error:
        problem = str(error)
    if problem is None:
        return Finding("GPU", True, *_free_memory())
    text, _, fix = problem.partition(". ")
    return Finding("GPU", False, text, fix)


def _free_memory() -> tuple[str, str]:
    """How much of the GPU's memory is free, and what to do where that is little."""
    import torch

    try:
        free, total = torch.cuda.mem_get_info()
    except RuntimeError as error:
        return f"will be used, its free memory is unknown: {_first_line(error)}", ""
    text = f"will be used, {size(free)} of {size(total)} of its memory is free"
    if free >= LEAST_FREE:
        return text, ""
    return text, "Stop other programs on this GPU, or runs lower resolution or number of surfels"


def _cores() -> Finding:
    return Finding("cores", True, str(core_count()))


def _memory() -> Finding:
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return Finding("memory", True, "unknown")
    ok = total >= ENOUGH_MEMORY
    fix = "" if ok else "Use --recipe preview, and a smaller ingest.max_side"
    return Finding("memory", ok, size(total), fix)


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    ok = free >= ENOUGH_DISK
    fix = "" if ok else "Free some space, or put the workspace elsewhere with -w"
    return Finding("disk here", ok, f"{size(free)} free", fix)


def _version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "installed"


def _first_line(error: BaseException) -> str:
    lines = [line for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
