"""One GPU for one job: an OS lock for each GPU of a machine, which ends with its process."""

import os
import stat
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from refdgs_pipe.cli.gpus import visible_gpus
from refdgs_pipe.errors import InputError
from refdgs_pipe.pipeline.atomic import disk_errors

# schedulers that hand out devices themselves; there "0" is another GPU in every job
_SCHEDULERS = ("SLURM_JOB_ID", "KUBERNETES_SERVICE_HOST")
_PAUSE_S = 1.0


@contextmanager
def own_gpu(names: Sequence[str] | None = None, folder: Path | None = None) -> Iterator[str | None]:
    """Hold one GPU of this machine, and let this process see no other. Wait until one is free.

    It must be entered before CUDA is used. Where Slurm or Kubernetes hand out devices, and where
    there is no GPU, nothing is locked.

    Args:
        names: of the GPUs to choose from; None: `visible_gpus`.
        folder: where the locks are; None: one of this user's in the folder for temporary files.

    Raises:
        InputError: the folder of the locks is not this user's own.
        WriteError: it cannot be written.
    """
    names = visible_gpus() if names is None else names
    if not names or any(name in os.environ for name in _SCHEDULERS):
        yield None
        return
    from filelock import FileLock, Timeout

    folder = _own_folder() if folder is None else folder
    while True:
        for name in names:
            lock = FileLock(folder / f"{name}.lock", timeout=0, fallback_to_soft=False)
            try:
                lock.acquire()
            except Timeout:
                continue
            os.environ["CUDA_VISIBLE_DEVICES"] = name
            try:
                yield name
            finally:
                lock.release()
            return
        time.sleep(_PAUSE_S)


def _own_folder() -> Path:
    folder = Path(tempfile.gettempdir()) / f"refdgs-pipe-gpus-{os.getuid()}"
    with disk_errors(folder.parent):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise InputError(f"{folder}: not a folder of yours. Delete it, or set TMPDIR to another")
    return folder
