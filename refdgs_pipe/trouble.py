"""Failures of the machine in words: memory, disks, locks. What is left is a bug of ours."""

import errno
import os
import re

from refdgs_pipe.errors import (
    CaptureError,
    DiskFault,
    InputError,
    OutOfMemory,
    RefdgsError,
    SystemLimit,
    WriteError,
)
from refdgs_pipe.formatting import printable

_BROKEN = {
    *(errno.EIO, errno.ENXIO, errno.ENODEV, errno.ESTALE, errno.EREMOTEIO),
    *(errno.ETIMEDOUT, errno.ENOTCONN, errno.EHOSTDOWN, errno.EBADMSG, errno.EUCLEAN),
}
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_FORBIDDEN = {errno.EACCES, errno.EPERM, errno.EROFS}
_LIMITS = {
    errno.ENOLCK: "this place has no file locks. Put the workspace on a local disk, with -w",
    errno.ENOSYS: "this place lacks what is needed. Put the workspace on a local disk, with -w",
    errno.EOPNOTSUPP: "this place lacks what is needed. Put the workspace on a local disk, with -w",
    errno.EMFILE: "too many files are open. Raise the limit: ulimit -n 4096",
    errno.ENFILE: "too many files are open on this machine. End other programs",
    errno.EAGAIN: "no more processes or threads can be started. Raise the limit: ulimit -u",
    errno.ETXTBSY: "another program holds the file. End that program",
}
# what libraries that have no error of their own for it say
_MEMORY_WORDS = re.compile(
    r"out of memory|not enough memory|cannot allocate memory|failed to allocate|bad_alloc"
    r"|insufficient memory|unsufficient memory|unable to allocate|can't allocate memory"
    r"|failed to map segment",
    re.IGNORECASE,
)
_MEMORY_ADVICE = (
    "Close other programs, use fewer --threads, or smaller photos: --set ingest.max_side=1600"
)


def is_memory(error: BaseException) -> bool:
    """Whether an error says that memory could not be had, whichever library raised it."""
    if isinstance(error, MemoryError | OutOfMemory):
        return True
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    if isinstance(error, RefdgsError):
        return False
    return bool(_MEMORY_WORDS.search(str(error)))


def is_broken(error: BaseException) -> bool:
    """Whether an error says that a disk or a network drive fails."""
    return isinstance(error, OSError) and error.errno in _BROKEN


def raise_if_machine(error: BaseException) -> None:
    """Go on with a failure of the machine, which is none of a file's: it must not be skipped.

    Raises:
        OutOfMemory, DiskFault: `error` is one.
    """
    if is_memory(error) or is_broken(error):
        found = explained(error)
        assert found is not None
        raise found from error


def explained(error: BaseException) -> RefdgsError | None:
    """What the user should know of a failure of the machine; None if it is a bug."""
    if isinstance(error, RefdgsError):
        return error
    if is_memory(error):
        return OutOfMemory(f"the memory does not suffice ({_first_line(error)}). {_MEMORY_ADVICE}")
    if isinstance(error, UnicodeEncodeError):
        name = printable(error.object)[:200]
        return InputError(f"{name}: a name that is not UTF-8. Rename the file or folder")
    if not isinstance(error, OSError) or error.errno is None:
        return None
    place = printable(error.filename) if error.filename else "a file"
    said = os.strerror(error.errno)
    if error.errno in _BROKEN:
        return DiskFault(
            f"{place}: the disk or network drive fails ({said}). Check it, copy what is on it, "
            "and run again"
        )
    if error.errno in _FULL:
        return WriteError(f"{place}: no space left on the disk ({said}). Free some, run again")
    if error.errno in _FORBIDDEN:
        return WriteError(f"{place}: may not be used ({said}). Change its permissions")
    if error.errno == errno.ENAMETOOLONG:
        return InputError(f"{place[:100]}...: the name is too long for this disk. Shorten it")
    if error.errno == errno.ELOOP:
        return CaptureError(f"{place}: a link, which is not followed here. Give the file itself")
    if error.errno in _LIMITS:
        return SystemLimit(f"{place}: {_LIMITS[error.errno]} ({said})")
    return None


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    return printable(lines[0])[:160] if lines else type(error).__name__
