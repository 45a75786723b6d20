"""Every error a user can meet, with its exit code. The README publishes the table.

RefdgsError             70  a bug; never raised itself
├── InputError          64  the command line, recipe or a named file is wrong: fix it and try again
├── CaptureError        65  the photos cannot be used
├── PoseError           66  too few photos found their place
├── TrainingError       67  training diverged; the last good state is kept
├── MeshError           68  no usable surface came out
├── ExportError         69  a written file did not pass its validator
├── DeviceError         71  the wanted GPU or a library of the system is missing, or does not fit
├── WorkspaceBusy       72  another process is working in this workspace
├── WriteError          73  the disk is full, read-only or forbidden
├── CorruptError        74  a file on disk is damaged
├── Interrupted         75  told to stop from outside (SIGTERM); the next run resumes
├── OutOfMemory         76  the memory does not suffice
├── DiskFault           77  a disk or a network drive fails to read or write
├── SystemLimit         78  the system refuses: no file locks, or too many open files
└── Cancelled          130  Ctrl-C; what was finished is kept, the next run resumes
"""


class RefdgsError(Exception):
    """Shown to the user as one message, without a traceback."""

    exit_code = 70


class InputError(RefdgsError):
    exit_code = 64


class CaptureError(RefdgsError):
    exit_code = 65


class PoseError(RefdgsError):
    exit_code = 66


class TrainingError(RefdgsError):
    exit_code = 67


class MeshError(RefdgsError):
    exit_code = 68


class ExportError(RefdgsError):
    exit_code = 69


class DeviceError(RefdgsError):
    exit_code = 71


class WorkspaceBusy(RefdgsError):
    exit_code = 72


class WriteError(RefdgsError):
    exit_code = 73


class CorruptError(RefdgsError):
    exit_code = 74


class OutOfMemory(RefdgsError):
    exit_code = 76


class DiskFault(RefdgsError):
    exit_code = 77


class SystemLimit(RefdgsError):
    exit_code = 78


class Cancelled(RefdgsError):
    exit_code = 130


class Interrupted(Cancelled):
    exit_code = 75


class ShapeError(ValueError):
    """Array sizes that must agree do not. A mistake in code, not in a user's input."""
