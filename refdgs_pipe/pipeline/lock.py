"""The lock of a workspace. The system frees it when its process dies, however it dies."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from refdgs_pipe.documents import read_text
from refdgs_pipe.errors import InputError, WorkspaceBusy
from refdgs_pipe.formatting import printable
from refdgs_pipe.pipeline.atomic import disk_errors, write_text

LOCK = ".lock"
OWNER = ".lock-owner"  # serves only the words of WorkspaceBusy


@contextmanager
def locked(root: Path) -> Iterator[None]:
    """Keep other processes out of a workspace.

    Raises:
        WorkspaceBusy: another process holds the lock.
        WriteError: the workspace cannot be written.
        SystemLimit: the file system has no locks.
        InputError: the lock is a link.
    """
    from filelock import FileLock, Timeout

    with disk_errors(root):
        root.mkdir(parents=True, exist_ok=True)
        if (root / LOCK).is_symlink():
            raise InputError(f"{root / LOCK}: is a link. A workspace holds no links: delete it")
        # not the soft lock of filelock: its file would outlive a process that is killed
        lock = FileLock(root / LOCK, timeout=0, fallback_to_soft=False)
        try:
            lock.acquire()
        except Timeout:
            raise WorkspaceBusy(
                f"{root}: {_owner(root)} is working here. Wait for it, or stop it"
            ) from None
        with suppress(OSError):
            write_text(root / OWNER, f"{os.getpid()} {socket.gethostname()}")
    try:
        yield
    finally:
        lock.release()


def _owner(root: Path) -> str:
    """Who wrote that it holds the lock, as far as that can be true."""
    try:
        number, host = read_text(root / OWNER, limit=1000, follow=False).split(maxsplit=1)
        process = int(number)
    except (OSError, ValueError):
        return "another process"
    if host != socket.gethostname():
        return f"process {process} on {printable(host)}"
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return "another process"  # the note is that of one before
    except PermissionError:
        pass
    return f"process {process}"
