"""Changes on disk that happen whole or not at all, whatever moment the process dies at."""

import ctypes
import errno
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from refdgs_pipe.documents import write_json_text
from refdgs_pipe.errors import RefdgsError, WriteError
from refdgs_pipe.trouble import explained, raise_if_machine


def write_json(path: Path, record: Any) -> None:
    """Replace a small file. Readers see the old record or the new one."""
    write_text(path, write_json_text(record) + "\n")


def write_text(path: Path, text: str, *, durable: bool = True) -> None:
    """Replace a small file. Readers see the old text or the new one; a link is replaced itself.

    Args:
        durable: wait until it is on the disk.
    """
    temporary = path.with_name(f".{path.name}-{os.getpid()}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
    try:
        with suppress(FileNotFoundError):
            temporary.unlink()
        with os.fdopen(os.open(temporary, flags, 0o666), "wb") as file:
            file.write(text.encode("utf-8", "backslashreplace"))
            file.flush()
            if durable:
                os.fsync(file.fileno())
        temporary.replace(path)
    except OSError:
        with suppress(OSError):
            temporary.unlink()
        raise
    if durable:
        sync(path.parent)


def sync(path: Path) -> None:
    """Wait until a file, or the list of names in a folder, is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Wait until everything below a folder is on the disk."""
    for path in sorted(folder.rglob("*"), reverse=True):
        sync(path)
    sync(folder)


def publish(new: Path, target: Path) -> None:
    """Put a folder, already on the disk, in the place of another one. `new` is gone afterwards."""
    if not target.exists():
        new.rename(target)
    elif _exchange(new, target):
        remove(new)
    else:  # a file system that cannot exchange: for an instant there is only the old one's spare
        spare = _spare(target)
        remove(spare)
        target.rename(spare)
        new.rename(target)
        remove(spare)
    sync(target.parent)


def rescue(target: Path) -> None:
    """Finish a `publish` that was killed half-way: what was there is there again."""
    spare = _spare(target)
    if spare.exists() and not target.exists():
        spare.rename(target)
    remove(spare)


def remove(path: Path) -> None:
    """Delete a file or folder, if it is there. It is renamed first: no reader meets half of it."""
    trash = path.with_name(f".trash-{path.name.lstrip('.').removeprefix('trash-')}")
    with suppress(FileNotFoundError):
        if path != trash:
            _delete(trash)
            path.rename(trash)
        _delete(trash)


def _delete(path: Path) -> None:
    """Delete what is there: a folder with all in it, a file, or a link itself."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _spare(target: Path) -> Path:
    return target.with_name(f".old-{target.name}")


def _exchange(one: Path, other: Path) -> bool:
    """Swap two names in one step, where the system can."""
    if sys.platform != "linux":
        return False
    AT_FDCWD, RENAME_EXCHANGE = -100, 2
    renameat2 = getattr(ctypes.CDLL(None), "renameat2", None)
    if renameat2 is None:
        return False
    status = renameat2(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE)
    return bool(status == 0)


@contextmanager
def disk_errors(root: Path) -> Iterator[None]:
    """Turn a failure to write below `root` into words.

    Raises:
        WriteError: the disk is full, read-only or forbidden.
        DiskFault, OutOfMemory: the machine fails.
    """
    try:
        yield
    except RefdgsError:
        raise
    except Exception as error:
        raise_if_machine(error)
        if message := _explain(error, root):
            raise WriteError(message) from error
        if found := explained(error):
            raise found from error
        raise


def _explain(error: Exception, root: Path) -> str | None:
    """What the user should know, or None if the disk is not to blame."""
    number = error.errno if isinstance(error, OSError) else None
    place = Path(getattr(error, "filename", None) or root)
    if number in (errno.ENOSPC, errno.EDQUOT) or _is_full(root):
        return (
            f"{root}: no space left on the disk. Nothing finished is lost: free some space"
            " and run again"
        )
    if number == errno.EROFS:
        return f"{place}: the disk is read-only. Choose another workspace with -w"
    if number in (errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST) and (
        place.is_relative_to(root) or root.is_relative_to(place)
    ):
        return f"{place}: cannot write here ({os.strerror(number)}). Choose another with -w"
    return None


def _is_full(folder: Path) -> bool:
    """Whether the disk is as good as full: native libraries do not always say so."""
    try:
        return shutil.disk_usage(folder).free < 1 << 20
    except OSError:
        return False
