"""Programs of the user's that pack a GLB's mesh (EXT_meshopt_compression)."""

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

from refdgs_pipe.errors import ExportError
from refdgs_pipe.export.glb_reading import split_glb, view_of

_TIMEOUT_S = 300
_MESHOPT = {"EXT_meshopt_compression", "KHR_meshopt_compression"}


@dataclass(frozen=True)
class Packer:
    """A program and what it is told.

    Args:
        name: of the program; `version` asks for its version.
        pack: arguments; {source} and {target} stand for the files.
    """

    name: str
    version: str
    pack: tuple[str, ...]


# Both keep the quantisation as it is and the images as they are.
PACKERS = (
    Packer(
        "gltf-transform",
        "--version",
        (
            *("meshopt", "{source}", "{target}", "--level", "medium"),
            *("--quantize-position", "16", "--quantize-texcoord", "16", "--quantize-normal", "16"),
        ),
    ),
    Packer(
        "gltfpack",
        "-v",
        (
            *("-i", "{source}", "-o", "{target}", "-c", "-ce", "ext"),
            *("-vp", "16", "-vt", "16", "-vn", "8", "-kn", "-km", "-ke"),
        ),
    ),
)
NONE_FOUND = (
    "no file packed with meshopt: neither gltf-transform nor gltfpack is on the PATH. For one, "
    "npm install -g @gltf-transform/cli, then: refdgs-pipe rerun WORKSPACE export"
)


def found() -> tuple[Packer, str] | None:
    """The first packer on the PATH, and where it is."""
    for packer in PACKERS:
        if path := shutil.which(packer.name):
            return packer, path
    return None


def packed(packer: Packer, program: str, source: Path, target: Path) -> str:
    """Write `target` from `source`; the program's name and version are returned.

    Raises:
        ExportError: the program failed, or did not write what it should.
    """
    told = [part.format(source=source, target=target) for part in packer.pack]
    version = _run([program, packer.version]).strip().splitlines()
    _run([program, *told])
    if faults := packed_faults(target, source):
        target.unlink(missing_ok=True)
        raise ExportError(f"{packer.name} wrote a file that is not sound: {faults[0]}")
    return f"{packer.name} {version[0].split()[-1] if version else ''}".strip()


def _run(command: list[str]) -> str:
    """What a program prints.

    Raises:
        ExportError: it cannot be started, takes too long, or fails.
    """
    name = Path(command[0]).name
    try:
        run = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=_TIMEOUT_S
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ExportError(f"{name} cannot be used: {error}") from error
    if run.returncode:
        last = (run.stderr.strip() or run.stdout.strip() or "it said nothing").splitlines()[-1]
        raise ExportError(f"{name} ended with exit code {run.returncode}: {last}")
    return run.stdout


def packed_faults(path: Path, source: Path) -> list[str]:
    """What is wrong with a packed GLB: its triangles and images must be those of its source."""
    try:
        document, binary = split_glb(path.read_bytes())
        first, first_binary = split_glb(source.read_bytes())
        faults = []
        if not _MESHOPT & set(document.get("extensionsRequired", [])):
            faults.append("it is not packed with meshopt")
        if _indices(document) != _indices(first):
            faults.append(f"{_indices(document)} indices, not {_indices(first)}")
        images = [view_of(document, binary, i["bufferView"]) for i in document["images"]]
        wanted = [view_of(first, first_binary, i["bufferView"]) for i in first["images"]]
        if sorted(images) != sorted(wanted):
            faults.append("its images are not those that it was given")
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        return [f"structure: {error!r}"]
    return faults


def _indices(document: dict[str, object]) -> int:
    ((primitive,),) = (mesh["primitives"] for mesh in document["meshes"])  # type: ignore[attr-defined]
    return int(document["accessors"][primitive["indices"]]["count"])  # type: ignore[index]
