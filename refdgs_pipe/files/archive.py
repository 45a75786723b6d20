"""A ZIP of photos: looked over before anything is written, then unpacked into a folder of ours.

What a ZIP says of itself is not believed: no member may lie outside the folder, no link is made,
and no member may grow beyond the size that its entry states.
"""

import errno
import shutil
import stat
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from refdgs_pipe.errors import CaptureError, WriteError
from refdgs_pipe.files.kinds import sniff
from refdgs_pipe.formatting import printable, size
from refdgs_pipe.trouble import raise_if_machine

MAX_MEMBERS = 20_000
MAX_BYTES = 64_000_000_000  # unpacked
MAX_RATIO = 200  # unpacked to packed, the whole file; photos hardly pack at all
SMALL = 50_000_000  # bytes: below this the ratio does not matter
_BLOCK = 1 << 20


def check_zip(path: Path) -> None:
    """Refuse a ZIP that cannot or must not be unpacked, by its directory alone.

    Raises:
        CaptureError: damaged, encrypted, too large, or with members that lead elsewhere.
    """
    _members(path)


def unpack_zip(path: Path, folder: Path) -> None:
    """Unpack the members that could be photos, masks or poses below an empty folder.

    Raises:
        CaptureError: as `check_zip`, or a member is damaged.
        WriteError: the disk has no room for it.
    """
    members = _members(path)
    total = sum(member.file_size for member in members)
    folder.mkdir(parents=True, exist_ok=True)
    if (free := shutil.disk_usage(folder).free) < total:
        raise WriteError(
            f"{folder}: {size(free)} free, {size(total)} needed to unpack {printable(path.name)}"
        )
    with zipfile.ZipFile(path) as archive:
        for member in members:
            target = folder.joinpath(*PurePosixPath(member.filename).parts)
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(member) as source, target.open("xb") as sink:
                    shutil.copyfileobj(source, sink, _BLOCK)
            except (zipfile.BadZipFile, zlib.error, RuntimeError, EOFError) as error:
                raise _refused(path, f"{member.filename} is damaged ({error})") from None
            except OSError as error:
                raise_if_machine(error)
                if error.errno in (errno.ENOSPC, errno.EDQUOT):
                    raise
                raise _refused(path, f"{member.filename}: {error.strerror}") from None
            if sniff(target) == "zip":
                raise _refused(path, f"{member.filename} is a ZIP in the ZIP. Unpack it first")


def _members(path: Path) -> list[zipfile.ZipInfo]:
    """The members to unpack: all but folders, hidden files and what macOS adds."""
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
    except (zipfile.BadZipFile, RuntimeError, OSError, ValueError, struct.error) as error:
        raise_if_machine(error)
        raise _refused(path, f"damaged ({error}). Copy it again") from None
    if len(infos) > MAX_MEMBERS:
        raise _refused(path, f"{len(infos)} files; at most {MAX_MEMBERS} are read")
    total, packed = sum(i.file_size for i in infos), max(1, path.stat().st_size)
    if total > MAX_BYTES:
        raise _refused(path, f"{size(total)} unpacked; at most {size(MAX_BYTES)} are read")
    if total > SMALL and total > MAX_RATIO * packed:
        raise _refused(
            path, f"unpacks to {total // packed} times its size, as no photos do (ZIP bomb?)"
        )
    for info in infos:
        _check(path, info)
    kept = [info for info in infos if not info.is_dir() and not _is_hidden(info.filename)]
    names = [info.filename for info in kept]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise _refused(path, f"{twice} is in it twice")
    return kept


def _check(path: Path, info: zipfile.ZipInfo) -> None:
    """Refuse a member that leads elsewhere or cannot be read."""
    name = info.filename
    if "\0" in info.orig_filename or "\0" in name:
        raise _refused(path, f"{info.orig_filename} has a NUL in its name. Pack the folder again")
    if not name:
        raise _refused(path, "a file without a name is in it. Pack the folder again")
    plain = name.replace("\\", "/")
    if plain.startswith("/") or (len(plain) > 1 and plain[1] == ":"):
        raise _refused(path, f"{name} has an absolute path. Pack the folder again")
    if ".." in plain.split("/"):
        raise _refused(path, f"{name} leads outside the ZIP (..). Pack the folder again")
    if stat.S_ISLNK(info.external_attr >> 16):
        raise _refused(path, f"{name} is a link. Pack the files themselves")
    if info.flag_bits & 1:
        raise _refused(path, f"{name} is encrypted. Pack it without a password")
    if plain.lower().endswith(".zip"):
        raise _refused(path, f"{name} is a ZIP in the ZIP. Unpack it first")


def _is_hidden(name: str) -> bool:
    parts = PurePosixPath(name).parts
    return any(part.startswith(".") or part == "__MACOSX" for part in parts)


def _refused(path: Path, text: str) -> CaptureError:
    return CaptureError(printable(f"{path.name}: {text}"))
